"""`with_plain_colours`: converts a map to view-independent colours in [0, 1] with the same appearance."""
# pyright: reportInvalidTypeForm=false

from dataclasses import asdict, replace

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0
from fields.runtime.engine import ti
from modp_ti.files.errors import InputError
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import MapRenderer
from modp_ti.outputs.progress import ProgressLine
from pipelines.optimise.adam import Adam, LearningRates

# Maximum number of views to fit, evenly spaced over the frames.
VIEWS = 60
STEPS = 900
# Initial learning rates of Adam, the position's relative to the scene's depth, and the decay factor at the end.
RATES = LearningRates(position=1e-4, log_scale=0.01, quaternion=0.002, opacity_logit=0.1, colour=0.04)
DECAY = 0.05
SSIM_WEIGHT = 0.2
# Value of the constant harmonic at which the colour reaches 1.
LARGEST = 0.5 / SH_C0


def with_plain_colours(run: FinishedRun, line: ProgressLine) -> dict[str, NDArray[np.float32]]:
    """Optimise a copy of the run's Gaussians to render alike with view-independent colours in [0, 1].

    Clipping alone would make a Gaussian brighter than 1 too dark if it is translucent. Therefore all parameters are
    fitted to the map's own renders from the mapped frames. Taichi must have been started.

    Args:
        run: The finished run.
        line: Shows the progress.

    Returns:
        Gaussians by name, as `GaussianField.load` takes them.

    Raises:
        InputError: If the map has more Gaussians than the engine can hold.
    """
    chosen = run.spread(VIEWS)
    cameras = [run.cameras[index] for index in chosen]
    maps = MapRenderer(run.gaussians, max(c.width for c in cameras), max(c.height for c in cameras), run.record.near)
    if not maps.is_whole:
        raise InputError(f"{run.folder}: the map is too large for plain colours, which are fitted to the whole of it")
    views = []
    for camera, T in zip(cameras, run.poses[chosen], strict=True):
        picture = maps.picture(camera, T)
        views.append((camera, T, np.dstack([picture, np.full(picture.shape[:2], 255, np.uint8)])))
    gaussians, renderer = maps.renderer.gaussians, maps.renderer
    adam, loss = Adam(gaussians), renderer.loss
    make_plain(gaussians.sh, len(gaussians), gaussians.sh_count)
    rates = asdict(replace(RATES, position=RATES.position * run.record.scene_depth))
    rng = np.random.default_rng(0)
    order: list[int] = []
    for step in line.through("fitting plain colours", range(STEPS), STEPS):
        order = order or rng.permutation(len(views)).tolist()
        camera, T, picture = views[order.pop()]
        renderer.forward(camera, T, run.record.near)
        loss.forward(picture)
        loss.backward(SSIM_WEIGHT)
        renderer.backward()
        decayed = DECAY ** (step / STEPS)
        adam.step(LearningRates(**{name: decayed * rate for name, rate in rates.items()}))
        make_plain(gaussians.sh, len(gaussians), gaussians.sh_count)
    return gaussians.to_numpy()


@ti.kernel
def make_plain(sh: ti.template(), count: ti.i32, sh_count: ti.template()):
    """Clip the constant harmonic to colours in [0, 1], and set the others to 0."""
    for i in range(count):
        sh[i, 0] = ti.min(ti.max(sh[i, 0], -LARGEST), LARGEST)
        for k in range(1, sh_count):
            sh[i, k].fill(0.0)
