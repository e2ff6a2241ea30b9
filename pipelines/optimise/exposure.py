"""Exposure: an affine colour transform (A, b) of each keyframe, estimated together with the map.

image = (A colour + b) * vignette. The transform of the first keyframe, and of the first at each place of its own, is
fixed to the identity, which removes the ambiguity between the transforms and the colours of the map. The others are
regularised towards the identity.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.optimise.light import COMPARED, DARK, SATURATED, light_changes, resized_vignette
from pipelines.optimise.safeguards import Safeguards
from pipelines.render.cpu.photometric_model import IDENTITY
from pipelines.render.renderer import Renderer
from pipelines.settings import ExposureSettings

__all__ = ["ExposureRefinement", "fitted_gains", "scene_colours"]

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
    """Colours of the scene at pixels of a view: its image with vignette and exposure removed.

    Args:
        view: The view.
        pixels: Integer pixels (N, 2) as (column, row).

    Returns:
        Colours (N, 3), clipped to [0, 2] if the view has a vignette or an exposure.
    """
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


class ExposureRefinement:
    """Adam on the exposure (A, b) of keyframes, which store its moments. New keyframes start from a fit to the map."""

    BETAS = (0.9, 0.999)

    def __init__(self, settings: ExposureSettings, safeguards: Safeguards | None = None) -> None:
        """Create the optimiser of exposures.

        Args:
            settings: Settings of the exposure.
            safeguards: Counter of skipped steps; None for a new one.
        """
        self.settings = settings
        self.safeguards = Safeguards() if safeguards is None else safeguards

    def begin(self, store: KeyframeStore, renderer: Renderer, near: float) -> None:
        """Initialise the exposure of the latest keyframe by a fit of gains to the current render, if enabled.

        With `enabled: auto`, exposures are estimated from the first keyframe on whose light has changed, see
        `light_changes`. All earlier keyframes then get the identity, which the first keyframe always has.

        A keyframe at a place of its own, which hardly sees the map, begins anew as the first keyframe of a map does,
        and so do those after it: the brightness of that place is free, and exposures that were estimated at once would
        all rise while its Gaussians are young and too dark. Back at an earlier place, they are estimated again. That a
        place begins is noted without exposures as well.

        Args:
            store: The keyframes.
            renderer: Renderer of the map. Its images are overwritten.
            near: Depth below which nothing is drawn [scene units].
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
            view.exposure, view.begins_place = unestimated, True
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
        """Make one Adam step on the exposure of a keyframe, with the regularisation towards the identity.

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
        gradient = gradient + 2.0 * weight * self.settings.regularisation * (exposure - IDENTITY)
        beta1, beta2 = self.BETAS
        view.exposure_steps += 1
        view.exposure_m = beta1 * view.exposure_m + (1 - beta1) * gradient
        view.exposure_v = beta2 * view.exposure_v + (1 - beta2) * gradient**2
        m = view.exposure_m / (1 - beta1**view.exposure_steps)
        v = view.exposure_v / (1 - beta2**view.exposure_steps)
        view.exposure = exposure - self.settings.learning_rate * m / (np.sqrt(v) + 1e-15)
