"""Exposure of keyframes: whether the light changes, the first fit, refinement by Adam, and the zero of all."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.map.gaussian_motion import GaussianMotion
from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.companions.companion import Companion
from pipelines.companions.paging import Paging
from pipelines.optimise.adam import Moments
from pipelines.render.formulas import IDENTITY
from pipelines.render.renderer import Renderer
from pipelines.safeguards import Safeguards
from pipelines.settings import ExposureSettings

# Darker values are mostly noise, brighter ones may be saturated: neither says how bright the image is.
DARK, SATURATED = 0.04, 0.96
# Earlier keyframes that the latest one is compared with.
COMPARED = 10
MIN_POINTS = 30
# Logarithmic change of brightness that counts. In constant light, 61 keyframes of the demo reach 0.014; desk, fox and
# redkitchen, whose exposure changes, reach 0.3 to 0.8.
CHANGED = 0.05
# Standard errors of the median by which a change must differ from zero.
SIGNIFICANT = 3.0
# Standard deviation of the blur before points are compared [px of the coarsest level].
BLUR = 1.0


def resized_vignette(vignette: NDArray[np.float32], rgba: NDArray[np.uint8]) -> NDArray[np.float32]:
    """The vignette (H, W, 3) at the size of an image, which may be a level of its pyramid."""
    height, width = rgba.shape[:2]
    if vignette.shape[:2] == (height, width):
        return vignette
    return np.asarray(cv2.resize(vignette, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)


def light_changes(store: KeyframeStore) -> bool:
    """Whether the tracked points of earlier keyframes are brighter or darker in the latest one, of the latest place.

    The points are projected into the latest keyframe, without a test of visibility: the median ratio of the colours
    treats occluded points, highlights and moving things as outliers. The map is not needed, so that a young one, whose
    colours are still wrong, does not look like a change.
    """
    latest = store[-1]
    here = _colours(latest, store.levels)
    begins = store.place_begins
    for earlier in [k for k in store.selected[-COMPARED - 1 : -1] if k.index >= begins]:
        p = earlier.points.xyz @ latest.T_camera_world[:3, :3].T + latest.T_camera_world[:3, 3]
        front = (p[:, 2] > 0) & earlier.camera.contains(earlier.points.pixels)
        pixels, there = latest.camera.project(p[front]), earlier.points.pixels[front]
        seen = latest.camera.contains(pixels)
        a = _at(_colours(earlier, store.levels), there[seen], earlier)
        b = _at(here, pixels[seen], latest)
        sound = ((a > DARK) & (a < SATURATED) & (b > DARK) & (b < SATURATED)).all(axis=1)
        if sound.sum() < MIN_POINTS:
            continue
        ratio = np.log(b[sound] / a[sound]).mean(axis=1)
        change = float(np.median(ratio))
        # Standard error of a median, from the median absolute deviation of a normal distribution.
        error = 1.25 * 1.48 * float(np.median(np.abs(ratio - change))) / np.sqrt(len(ratio))
        if abs(change) > max(CHANGED, SIGNIFICANT * error):
            return True
    return False


def _colours(view: Keyframe, levels: int) -> NDArray[np.float32]:
    """Blurred colours (h, w, 3) of the coarsest of `levels` pyramid levels, without the vignette."""
    rgba = view.image(levels).rgba
    image = rgba[..., :3].astype(np.float32) / 255.0
    if view.vignette is not None:
        image /= resized_vignette(view.vignette, rgba)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR), dtype=np.float32)


def _at(image: NDArray[np.float32], pixels: NDArray[np.float64], view: Keyframe) -> NDArray[np.float32]:
    """Colours (N, 3) of a level's image at pixels (N, 2) of the view's full size."""
    height, width = image.shape[:2]
    column, row = np.floor(pixels * [width / view.camera.width, height / view.camera.height]).astype(int).T
    return image[np.minimum(row, height - 1), np.minimum(column, width - 1)]


# Pixels whose rendered opacity is at most this are not used to fit an exposure.
MIN_OPACITY = 0.9
MIN_PIXELS = 100
# Share of the image in which a keyframe at a place of its own may see the map: a copy of redkitchen five scene depths
# away saw 0 to 8 % of it, from gaps and fringes of others. Back at an earlier place, the map fills most of an image.
APART = 0.25
# Scene colours may exceed the white of a photograph (1), but not by more than a short exposure explains.
BRIGHTEST = 2.0
# A keyframe starts within this factor of the map's brightness.
LARGEST_GAIN = 4.0


def scene_colours(view: Keyframe, pixels: NDArray[np.int64]) -> NDArray[np.float64]:
    """Colours (N, 3) of the scene at integer pixels (N, 2) of a view: without vignette and exposure, within [0, 2]."""
    column, row = pixels.T
    colours = view.rgba[row, column, :3] / 255.0
    if view.vignette is not None:
        colours = colours / resized_vignette(view.vignette, view.rgba)[row, column]
    if view.exposure is not None:
        colours = (colours - view.exposure[:, 3]) @ np.linalg.pinv(view.exposure[:, :3]).T
    if view.vignette is None and view.exposure is None:
        return colours
    return np.clip(colours, 0.0, BRIGHTEST)


def fitted_gains(
    colours: NDArray[np.floating], image: NDArray[np.floating], otherwise: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Fit a gain per channel, image = gain * colours, as the median ratio, so that errors of the map act as outliers.

    A full (A, b) is not fitted: nearly grey images leave it undetermined, and errors of the rendered colours shrink it.

    Args:
        colours: Rendered colours (N, 3).
        image: Observed colours (N, 3).
        otherwise: Gains (3,) of channels with fewer than `MIN_PIXELS` values that are neither dark nor saturated.

    Returns:
        Gains (3,), from 1/4 to 4.
    """
    gains = np.array(otherwise, dtype=np.float64)
    for c in range(3):
        sound = (image[:, c] > DARK) & (image[:, c] < SATURATED) & (colours[:, c] > DARK)
        if sound.sum() >= MIN_PIXELS:
            gains[c] = np.median(image[sound, c] / colours[sound, c])
    return np.clip(gains, 1.0 / LARGEST_GAIN, LARGEST_GAIN)


def _is_elsewhere(store: KeyframeStore) -> bool:
    """Whether the latest keyframe tracks points, but none that the keyframes just before it track.

    Those must share points among themselves: the ids of some trackers never return, and tell nothing.
    """
    *earlier, latest = (keyframe.points.ids for keyframe in store.selected[-COMPARED - 1 :])
    known = np.concatenate(earlier)
    return len(latest) > 0 and len(np.unique(known)) < len(known) and not np.isin(latest, known).any()


class ExposureRefinement(Companion):
    """Adam on the exposure (A, b) of keyframes. New keyframes start from a fit to the map.

    Attributes:
        moments: Adam's moments of each keyframe.
    """

    def __init__(self, settings: ExposureSettings, safeguards: Safeguards | None = None) -> None:
        """Create the optimiser of exposures.

        Args:
            settings: Settings of the exposure.
            safeguards: Counter of skipped steps; None for a new one.
        """
        self.settings = settings
        self.safeguards = Safeguards() if safeguards is None else safeguards
        self.moments = Moments(3, 4)

    def new_keyframe(self, store: KeyframeStore, renderer: Renderer, near: float) -> None:
        """Initialise the exposure of the latest keyframe by a fit of gains to the current render, if enabled.

        With `enabled: auto`, exposures are estimated from the first keyframe on whose light has changed, see
        `light_changes`. All earlier keyframes then get the identity, which the first keyframe always has.

        A keyframe at a place of its own, which hardly sees the map, begins anew as the first keyframe of a map does,
        and so do those after it: the brightness of that place is free, and exposures that were estimated at once would
        all rise while its Gaussians are young and too dark. Back at an earlier place, they are estimated again. That a
        place begins is noted without exposures as well.
        """
        view, enabled = store[-1], self.settings.enabled
        unestimated = np.array(IDENTITY) if enabled is True else None
        if len(store) == 1:
            view.exposure = unestimated
            return
        elsewhere = _is_elsewhere(store)
        estimated = bool(enabled) and (view.exposure is not None or light_changes(store))
        if not (estimated or elsewhere):
            return
        small = view.at_level(store.levels)
        renderer.forward(small.camera, view.T_camera_world, near)
        known = (renderer.images.opacity_to_numpy() > MIN_OPACITY) & (small.rgba[..., 3] > 0)
        if elsewhere and known.mean() < APART:
            view.exposure = unestimated
            store.begins.add(view.index)
            return
        if not enabled or not (estimated or any(keyframe.exposure is not None for keyframe in store)):
            return
        before = IDENTITY if view.exposure is None else view.exposure
        if view.exposure is None:
            begins = store.place_begins
            for keyframe in store:
                if keyframe.index >= begins:
                    keyframe.exposure = np.array(IDENTITY)
        if known.sum() < MIN_PIXELS:
            return
        image = small.rgba[known][:, :3] / 255.0
        if view.vignette is not None:
            image = image / resized_vignette(view.vignette, small.rgba)[known]
        gains = fitted_gains(renderer.images.colour_to_numpy()[known], image, np.diag(before))
        view.exposure = np.column_stack([np.diag(gains), np.zeros(3)])

    def step(self, view: Keyframe, gradient: NDArray[np.float64], weight: float = 1.0) -> None:
        """Make one Adam step on the exposure of a keyframe, with the regularisation towards a plain gain.

        A step with a gradient that is not finite is skipped.

        Args:
            view: The keyframe.
            gradient: d loss / d (A, b) (3, 4).
            weight: Weight of the view in the loss, which also scales the regularisation.
        """
        if not np.isfinite(gradient).all():
            self.safeguards.exposure_steps += 1
            return
        exposure = IDENTITY if view.exposure is None else view.exposure
        pull = exposure - np.diagonal(exposure).mean() * IDENTITY
        gradient = gradient + 2.0 * weight * self.settings.regularisation * pull
        view.exposure = exposure - self.moments.step(view.index, gradient, self.settings.learning_rate)


# Change of the map's colours that is not made: blocks on disk would be written again for it.
NEGLIGIBLE = 0.005


class ExposureZero(Companion):
    """Holds the interquartile means of the keyframes' log gains and offsets at zero, in each channel.

    Exposures and the map's colours share a gain g and an offset h, since A colour + b = (A / g) (g colour + h) + b -
    (A / g) h. The first keyframe decides them as it begins with the identity: a dark first image would darken the
    whole map. A plain mean would follow it, and a median jump where few keyframes differ: on desk, such an image moves
    them by 4 % and 3 %, this one by 1 %. Renders of keyframes stay the same where they are opaque. Nothing happens
    while a keyframe has no exposure.

    Args:
        keyframes: The keyframes of the map.
        gaussians: The Gaussians in memory.
        paging: Keeps the part of the map that is on disk.
    """

    def __init__(self, keyframes: KeyframeStore, gaussians: GaussianField, paging: Paging) -> None:
        self.keyframes = keyframes
        self.paging = paging
        self.motion = GaussianMotion(gaussians)

    def new_keyframe(self, store: KeyframeStore, renderer: Renderer, near: float) -> None:
        self.hold()

    def before_passes(self, places: NDArray[np.int64], near: float) -> None:
        self.hold()

    def hold(self) -> None:
        """Move the zero to the middle of the keyframes. Call it between steps."""
        found = [view.exposure for view in self.keyframes if view.exposure is not None]
        if len(found) < max(len(self.keyframes), 1):
            return
        exposures = np.array(found)
        gain = np.exp(_middle(np.log(np.maximum(np.diagonal(exposures, axis1=1, axis2=2), DARK))))
        offset = _middle(exposures[:, :, 3])
        if max(np.abs(gain - 1.0).max(), np.abs(offset).max()) <= NEGLIGIBLE:
            return
        A = exposures[:, :, :3] / gain
        for view, exposure in zip(self.keyframes, np.dstack([A, exposures[:, :, 3] - A @ offset]), strict=True):
            view.exposure = exposure
        self.motion.recolour(gain, offset)
        self.paging.rewrite(lambda first: self.motion.recolour(gain, offset, first))


def _middle(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interquartile mean (3,) of values (K, 3)."""
    cut = len(values) // 4
    return np.sort(values, axis=0)[cut : len(values) - cut].mean(axis=0)
