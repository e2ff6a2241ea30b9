"use strict";
// What one measures in the page by clicking at the map, as `measuring.py` does. Vectors are arrays [x, y, z] in the page's
// coordinates, whose y points up.
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const sum = (a, b, factor = 1) => a.map((x, i) => x + factor * b[i]);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const norm = (a) => Math.hypot(...a);
const SPLAT = ["x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3", "scale_0", "scale_1", "scale_2", "opacity"];
const scaled = (a, factor) => a.map((x) => factor * x);

// Returns where a ray from the eye along the unit vector d meets the surface: the median depth by the weights with which
// splats are composited, {at, d, along, side}, with deviations along and across the ray; null where the map is thin.
// `pixel` is the angle of a pixel.
function surfacePoint(splats, eye, d, pixel) {
  const REACH = 3.5, BLUR = 0.3, ALPHA_MIN = 1 / 255, SOLID = 0.5;
  const { x, y, z, rot_0: qw, rot_1: qx, rot_2: qy, rot_3: qz, scale_0: s0, scale_1: s1, scale_2: s2, opacity } = splats;
  // The viewer turns maps by half a turn around z.
  const [ex, ey, ez, dx, dy, dz] = [-eye[0], -eye[1], eye[2], -d[0], -d[1], d[2]];
  const met = [];
  for (let i = 0; i < x.length; i++) {
    const vx = x[i] - ex, vy = y[i] - ey, vz = z[i] - ez;
    const along = vx * dx + vy * dy + vz * dz;
    if (along <= 0) continue;
    const reach = REACH * (Math.exp(Math.max(s0[i], s1[i], s2[i])) + pixel * along);
    if (vx * vx + vy * vy + vz * vz - along * along > reach * reach) continue;
    // The ray in the splat's axes, whose covariance there is diagonal; a pixel's footprint is added to it, for which
    // its opacity is compensated by the ratio of the areas across the ray.
    const n = 1 / Math.hypot(qw[i], qx[i], qy[i], qz[i]), w = n * qw[i], q = [n * qx[i], n * qy[i], n * qz[i]];
    const turned = (v) => sum(sum(v, cross(q, v), -2 * w), cross(q, cross(q, v)), 2);
    const v = turned([vx, vy, vz]), r = turned([dx, dy, dz]);
    let a = 0, b = 0, c = 0, sharp = 0, before = 1, after = 1;
    [s0[i], s1[i], s2[i]].forEach((s, k) => {
      const own = Math.exp(2 * s), variance = own + BLUR * (pixel * along) ** 2;
      a += r[k] * r[k] / variance;
      b += r[k] * v[k] / variance;
      c += v[k] * v[k] / variance;
      sharp += r[k] * r[k] / own;
      before *= own;
      after *= variance;
    });
    const compensation = Math.sqrt(before * sharp / (after * a));
    const alpha = Math.min(compensation / (1 + Math.exp(-opacity[i])) * Math.exp(0.5 * (b * b / a - c)), 0.99);
    if (alpha >= ALPHA_MIN) met.push({ depth: b / a, variance: 1 / a, alpha });
  }
  met.sort((one, other) => one.depth - other.depth);
  let total = 0, left = 1;
  for (const splat of met) {
    total += splat.alpha * left;
    left *= 1 - splat.alpha;
    splat.total = total;
  }
  if (total < SOLID) return null;
  const [near, middle, far] = [0.16, 0.5, 0.84].map((share) => met.find((splat) => splat.total >= share * total));
  return {
    at: sum(eye, d, middle.depth),
    d,
    along: Math.hypot(0.5 * (far.depth - near.depth), Math.sqrt(middle.variance)),
    side: 0.5 * pixel * middle.depth,
  };
}

// Returns [value, deviation] of the length of a polyline through points of the surface, and of the area of their polygon,
// projected to its own plane.
function deviation(slopes, points) {
  return Math.sqrt(slopes.reduce((total, g, i) => {
    const { d, along, side } = points[i];
    return total + side ** 2 * dot(g, g) + (along ** 2 - side ** 2) * dot(g, d) ** 2;
  }, 0));
}
function lengthOf(points) {
  const slopes = points.map(() => [0, 0, 0]);
  let length = 0;
  for (let i = 1; i < points.length; i++) {
    const step = sum(points[i].at, points[i - 1].at, -1), size = norm(step), unit = scaled(step, 1 / (size || 1));
    length += size;
    slopes[i] = sum(slopes[i], unit);
    slopes[i - 1] = sum(slopes[i - 1], unit, -1);
  }
  return [length, deviation(slopes, points)];
}
function areaOf(points) {
  const at = (i) => points[(i + points.length) % points.length].at;
  let vector = [0, 0, 0];
  points.forEach((_, i) => { vector = sum(vector, cross(sum(at(i), at(0), -1), sum(at(i + 1), at(0), -1)), 0.5); });
  const area = norm(vector), normal = scaled(vector, 1 / (area || 1));
  return [area, deviation(points.map((_, i) => scaled(cross(sum(at(i + 1), at(i - 1), -1), normal), 0.5)), points)];
}

// Lets a button of the page start and end measuring. `world` has the unit, units per page unit, the relative deviation of
// the scale, and the floor's height, or null.
function addMeasuring(viewer, world) {
  const { app, state } = viewer, camera = app.root.findByName("camera"), canvas = app.graphicsDevice.canvas;
  const [button, output, drawing] = ["measure", "measured", "drawing"].map((id) => document.getElementById(id));
  const place = camera.getPosition().clone();
  let points = null, reading = null, pressed = null;
  const said = ([value, spread], power) => {
    const unit = world.scale ** power, spreads = Math.hypot(spread, power * world.deviation * value);
    return `${+(unit * value).toPrecision(4)} \u00b1 ${+(unit * spreads).toPrecision(2)} ${world.unit}${power > 1 ? "\u00b2" : ""}`;
  };
  function text() {
    if (!points.length) return "Click at two points or more. Drag to look around.";
    const last = points[points.length - 1], lines = [];
    if (points.length > 1) lines.push(`length ${said(lengthOf(points), 1)}`);
    if (points.length > 2) lines.push(`last ${said(lengthOf(points.slice(-2)), 1)}`, `area ${said(areaOf(points), 2)}`);
    if (world.floor !== null) {
      const spread = deviation([[0, 1, 0]], [last]);
      lines.push(`height over the floor ${said([last.at[1] - world.floor, spread], 1)}`);
    }
    return lines.join("\n") || "Click at another point.";
  }
  function draw() {
    if (!points) return;
    const seen = points.map(({ at }) => camera.camera.worldToScreen(place.set(...at))).filter((p) => p.z > 0);
    const path = seen.map((p) => `${p.x},${p.y}`).join(" ");
    drawing.innerHTML = `<polygon points="${path}"/><polyline points="${path}"/>`
      + seen.map((p) => `<circle cx="${p.x}" cy="${p.y}" r="4"/>`).join("");
    requestAnimationFrame(draw);
  }
  async function click(event) {
    const box = canvas.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    const eye = camera.getPosition(), way = (u, v) => {
      const there = camera.camera.screenToWorld(u, v, 1).sub(eye);
      return scaled([there.x, there.y, there.z], 1 / there.length());
    };
    const from = [eye.x, eye.y, eye.z], d = way(x, y), pixel = norm(sum(way(x, y + 1), d, -1));
    const found = surfacePoint(await reading, from, d, pixel);
    if (found) points?.push(found);
    if (points) output.textContent = found ? text() : "There is no surface of the map.";
  }
  async function read() {
    const map = app.assets.filter((asset) => asset.type === "gsplat")[0].resource.gsplatData;
    const data = map.decompress ? await map.decompress() : map;
    return Object.fromEntries(SPLAT.map((name) => [name, data.getProp(name)]));
  }
  button.addEventListener("click", () => {
    points = points ? null : [];
    button.setAttribute("aria-pressed", Boolean(points));
    drawing.innerHTML = "";
    output.textContent = points ? text() : "";
    if (points) state.cameraMode = "orbit";
    reading ??= read();
    draw();
  });
  canvas.addEventListener("pointerdown", (event) => { pressed = event.button === 0 ? event : null; });
  canvas.addEventListener("pointerup", (event) => {
    const still = pressed && Math.hypot(event.clientX - pressed.clientX, event.clientY - pressed.clientY) < 4;
    if (points && still) click(event);
  });
  // A click moves the viewer's camera otherwise.
  const fire = viewer.events.fire.bind(viewer.events), moves = ["pick", "orbitTarget:set", "navigateTo"];
  viewer.events.fire = (name, ...rest) => points && moves.includes(name) ? viewer.events : fire(name, ...rest);
  button.hidden = false;
}

// Lets a button start and end walking. The viewer's own is only there in maps that are wider than 5 m.
function addWalking({ state, events }) {
  const button = document.getElementById("walk");
  button.addEventListener("click", () => {
    state.cameraMode = state.cameraMode === "walk" ? "orbit" : "walk";
    button.blur();
  });
  events.on("cameraMode:changed", (mode) => button.setAttribute("aria-pressed", mode === "walk"));
  button.hidden = false;
}
