"""Settings of the pipelines, with one section per concept.

The sections are part of the configuration model (`modp_ti.config.settings.SceneConfig`). Lengths are relative to the
scene. A `view scale` is the median of depth / focal length over a view's tracked points, the width of a pixel at the
median depth (Section 3.2.1). The `scene depth` is the median over all keyframes of the median depth of their tracked
points.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from fields.frames.tracked_frame import MAX_LEVELS
from fields.runtime.engine import engine

# Share of the pixels of a keyframe that are of low SSIM before it is optimised, in the mean over the rooms at hand.
# Outdoors, where more of a picture is new, it is 50 to 80 percent.
USUAL_CANDIDATES = 0.28
# Views that a map of a few keyframes gets after the last frame.
LAST_VIEWS = 48


class StrictModel(BaseModel):
    """Immutable section of the configuration. Unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class KeyframeSettings(StrictModel):
    """When a frame becomes a keyframe (Section 3.3.1)."""

    covisibility: float = Field(
        default=0.95, ge=0, le=1, description="a frame that shares less with the last keyframe becomes one"
    )
    baseline: float = Field(
        default=0.02,
        gt=0,
        description="movement since the last keyframe that makes one [its median depths]",
    )
    max_gap: int = Field(default=5, ge=1, description="frames after which a keyframe is taken in any case (t_k)")
    max_rotation: float = Field(
        default=10.0,
        gt=0,
        description="degrees per frame beyond which a frame is a keyframe only if it is not blurred",
    )
    min_sharpness: float = Field(
        default=0.75, ge=0, le=1, description="sharpness, as a factor on the last keyframe's, below which it is"
    )
    min_points: int = Field(default=10, ge=0, description="tracked points that a keyframe needs")
    between: int = Field(
        default=0,
        ge=0,
        description="frames after a keyframe from which on the first sharp one becomes a view of optimisation too, "
        "without work of its own; 0 for none",
    )


class EpipolarSettings(StrictModel):
    """Depth from a search along epipolar lines in neighbouring keyframes."""

    views: int = Field(default=8, ge=1, description="neighbours that are searched")
    parallax: float = Field(
        default=0.15, gt=0, description="baseline to them that is preferred [the view's median depths]"
    )
    max_samples: int = Field(default=128, ge=8, description="samples of inverse depth along a line at most")
    min_score: float = Field(default=0.7, ge=-1, le=1, description="correlation (ZNCC) that a match must have")
    min_lead: float = Field(default=0.1, ge=0, le=2, description="by how much it must beat all others along the line")
    pixel_noise: float = Field(default=0.2, ge=0, description="standard deviation of a sharp match [px]")


DepthSource = Literal["constant", "image", "depthcov", "epipolar", "map"]


class DepthSettings(StrictModel):
    """Depth of pixels without a tracked point (Section 3.2.2)."""

    sources: tuple[DepthSource, ...] = Field(
        default=("image", "epipolar", "map"),
        min_length=1,
        description="estimators that are fused by inverse variance: Gaussian processes on the tracked points with a "
        "constant kernel (constant), one that follows the image (image) or DepthCov's (depthcov); matches in other "
        "keyframes (epipolar); the render of the map (map)",
    )
    max_points: int = Field(
        default=250, ge=10, description="tracked points that condition the process, drawn at random beyond"
    )
    max_deviation: float = Field(
        default=0.045,
        gt=0,
        description="standard deviation of log depth below which a pixel gets its Gaussian in any case",
    )
    max_misplacement: float = Field(
        default=2.0,
        ge=0,
        description="a pixel of uncertain depth gets its Gaussian if a depth wrong by its deviation moves it by less "
        "than this in other keyframes [px]; 0 for never",
    )
    hole_deviation: float = Field(
        default=0.15,
        gt=0,
        description="as max_deviation, where the map shows next to nothing: a wrong depth is better than a hole",
    )
    checkpoint: Path | None = Field(
        default=None,
        description="DepthCov's weights (`scannet.ckpt` or `nyu.ckpt`), a file of the user's own; for depthcov",
    )
    neighbours: int = Field(default=100, ge=0, description="latest other keyframes among which matches are looked for")
    epipolar: EpipolarSettings = EpipolarSettings()

    @model_validator(mode="after")
    def _checkpoint_is_given(self) -> DepthSettings:
        if "depthcov" in self.sources and self.checkpoint is None:
            raise ValueError("depthcov needs its weights: set checkpoint")
        return self


class DensifySettings(StrictModel):
    """Positions and initial values of new Gaussians (Section 3.2.2)."""

    error_compensation: bool = Field(
        default=True, description="also add Gaussians at pixels of low SSIM, not only at tracked points"
    )
    pixels: int = Field(
        default=6000,
        ge=0,
        description="such pixels per keyframe of 640x480, and in proportion to the candidates if these are more than "
        "28 percent of it; other sizes by the power 3/4 of their area",
    )
    dissimilarity: float = Field(default=0.08, ge=0, le=1, description="1 - SSIM from which a pixel is a candidate")
    warm_up: int = Field(
        default=8, ge=0, description="frames at the start that take random pixels instead of those of low SSIM"
    )
    initial_scale: float = Field(
        default=0.5, gt=0, description="size of a new Gaussian in pixels of its view, before scale_offset"
    )
    scale_offset: float = Field(default=0.5, description="added to the log of that size (epsilon of Eq. 1)")
    initial_opacity: float = Field(default=0.5, gt=0, lt=1, description="opacity of a new Gaussian")
    sky: bool = Field(
        default=True,
        description="add wide Gaussians in smooth regions at the upper edge of an image that the map does not show "
        "yet, far away where no depth is known",
    )
    min_contribution: float = Field(
        default=0.5,
        ge=0,
        description="pixels covered where it shows most, below which a Gaussian is removed, each time that the "
        "keyframes have become half as many again, from 64 on; 0 for never",
    )
    prune_every: int = Field(default=100, ge=1, description="frames between removals of transparent Gaussians")
    prune_opacity: float = Field(default=0.01, ge=0, lt=1, description="opacity below which a Gaussian is removed")

    def pixels_of(self, width: int, height: int, candidates: float = 0.0) -> float:
        """Return the number of pixels that a keyframe of this size [px] and share of candidates asks for."""
        return self.pixels * (width * height / (640 * 480)) ** 0.75 * max(1.0, candidates / USUAL_CANDIDATES)


class VoxelSettings(StrictModel):
    """Multi-level occupancy voxels (Section 3.2.3)."""

    enabled: bool = Field(default=True, description="filter new Gaussians by the voxels")
    levels: int = Field(default=8, ge=1, le=12, description="number of cell sizes (L)")
    resolution: int = Field(default=512, ge=1, description="coarsest cells a side that the finest level covers (n)")
    coarsest: float = Field(
        default=12.5, gt=0, description="coarsest cell (S_init) in view scales of the first keyframe"
    )
    target: float = Field(default=0.75, gt=0, description="spacing asked for in a view, in its view scales")


class ViewSettings(StrictModel):
    """Selection of the keyframes of an optimisation step (Section 3.3.2)."""

    # The paper takes one local and four global views. With few steps, five global views are better on every recording
    # at hand: the current view is one of six, and is itself local.
    local_views: int = Field(default=0, ge=0, description="views from the local bank per step")
    bank: int = Field(default=10, ge=1, description="keyframes in the local bank")
    global_views: int = Field(default=5, ge=0, description="views from all keyframes per step")
    error_weight: float = Field(
        default=20.0, ge=0, description="sigma of the mean absolute error in the draw of global views"
    )
    recency_weight: float = Field(default=0.001, ge=0, description="sigma of the age in keyframes in that draw")

    @property
    def per_step(self) -> int:
        """Number of views of a step, with the current one."""
        return 1 + self.local_views + self.global_views


class PoseSettings(StrictModel):
    """SE(3) refinement of keyframe poses (Section 3.3.3)."""

    enabled: bool = Field(default=True, description="refine keyframe poses while mapping")
    steps: int = Field(default=8, ge=0, description="first steps of a keyframe that also refine poses")
    learning_rate: float = Field(
        default=0.01, ge=0, description="Adam step of a pose, as the movement of its tracked points in the image [px]"
    )
    align: bool = Field(
        default=True, description="first move a new keyframe to where its tracked points project rightly"
    )


class CorrectionSettings(StrictModel):
    """Effect of a tracker's pose corrections (bundle adjustment, loop closures) on the map."""

    enabled: bool = Field(
        default=True,
        description="Gaussians follow the frames that placed them; without, corrections change poses alone",
    )
    min_pixels: float = Field(
        default=0.5,
        ge=0,
        description="displacement of a keyframe's picture beyond which they do [px]; smaller ones add up until then",
    )
    steps: int = Field(
        default=20, ge=0, description="optimisation steps on keyframes that have moved, after Gaussians have"
    )
    views: int = Field(default=4, ge=1, description="such keyframes per step, drawn as the global views are")


class LevelSettings(StrictModel):
    """Image pyramid: the level on which a new keyframe is optimised and densified."""

    probabilities: tuple[float, ...] = Field(
        default=(0.4, 0.3, 0.2, 0.1),
        min_length=1,
        max_length=MAX_LEVELS,
        description="of drawing the full size, the half, the quarter, ...; [1] for full size only: slower and finer",
    )
    # Levels down to 33 pixels cost half a decibel or more on desk and fox. Half of 320x240 is still worth its speed.
    min_side: int = Field(
        default=96,
        ge=1,
        description="no level has a shorter side of fewer pixels; 1 for the published pyramid: faster and coarser",
    )


class ExposureSettings(StrictModel):
    """Exposure of every keyframe, image = A colour + b, for cameras with automatic exposure."""

    enabled: Literal["auto"] | bool = Field(
        default="auto",
        description="estimate the exposure of keyframes with the map; auto: from the first keyframe on in which the "
        "tracked points have become brighter or darker",
    )
    learning_rate: float = Field(default=0.005, ge=0, description="Adam step of A (3x3) and b")
    regularisation: float = Field(
        default=0.03,
        ge=0,
        description="weight of |A - gain I|^2 + |b|^2 of a keyframe beside its loss, with its mean gain",
    )


class GateSettings(StrictModel):
    """Rejection of implausible frames: blank images, repeated images, and jumps of the pose."""

    enabled: bool = Field(default=True, description="leave such frames out; they keep their place in the outputs")
    min_contrast: float = Field(
        default=2.0, ge=0, description="standard deviation of the colours [of 255] below which an image shows nothing"
    )
    jump: float = Field(
        default=8.0,
        gt=1,
        description="motion of the camera, as a factor on the usual one, from which on the map is asked",
    )
    min_jump: float = Field(
        default=0.15, gt=0, description="motion that is never a jump [share of the image's diagonal]"
    )


class OptimiseSettings(StrictModel):
    """Loss and learning rates."""

    batch: int = Field(
        default=1, ge=1, description="views whose gradients make one Adam step; the views of a step are shared out"
    )

    steps: int = Field(default=12, ge=0, description="steps per keyframe")
    budget: int | None = Field(
        default=140,
        ge=1,
        description="keyframes up to which each gets all its steps; if a recording of known length has more, they "
        "share the steps of so many. Empty: all get all",
    )
    last_passes: int = Field(
        default=2,
        ge=0,
        description="passes over all keyframes after the last frame, at rates that decay; more if they are few",
    )
    ssim_weight: float = Field(default=0.2, ge=0, le=1, description="weight of 1 - SSIM beside L1")
    depth_weight: float = Field(
        default=0.05,
        ge=0,
        description="weight of the error of the rendered depth, where a sensor has measured that of the tracked points",
    )
    aspect_weight: float = Field(default=1.0, ge=0, description="weight of the penalty on Gaussians longer than 10:1")
    position_rate: float = Field(default=2e-4, ge=0, description="Adam step of positions [scene depths]")
    scale_rate: float = Field(default=4e-2, ge=0, description="Adam step of log-scales")
    rotation_rate: float = Field(default=4e-3, ge=0, description="Adam step of quaternions")
    opacity_rate: float = Field(default=0.05, ge=0, description="Adam step of opacity logits")
    colour_rate: float = Field(
        default=1e-2, ge=0, description="Adam step of the colour's constant harmonic; the others a twentieth"
    )

    def last_views(self, keyframes: int) -> int:
        """Return the number of views after the last frame: passes over the keyframes, at least `LAST_VIEWS` views."""
        if keyframes == 0 or self.last_passes == 0:
            return 0
        return keyframes * max(self.last_passes, -(-LAST_VIEWS // keyframes))


class MappingSettings(StrictModel):
    """The online loop.

    Example:
        mapper = modp_ti.Mapper(640, 480, modp_ti.MappingSettings(sh_degree=0))
    """

    sh_degree: int = Field(default=1, ge=0, le=3, description="degree of the spherical harmonics of colour")
    max_gaussians: int = Field(
        default=1_500_000,
        ge=1024,
        description="size of the pool; blocks of the map beyond it lie on disk (docs/scale.md). At most 1,500,000 with "
        "Taichi, 33,554,432 with Quadrants",
    )
    memory: float | None = Field(
        default=None,
        gt=0,
        description="memory that Gaussians, keyframes, voxels and what frames saw of tracked points may take [GB]; "
        "blocks of the map and images go to disk, and what still has no room is left out and counted",
    )
    near: float = Field(default=0.01, gt=0, description="nearest depth that is drawn [scene depths]")
    image_cache: float = Field(
        default=2.0,
        ge=0,
        description="memory of a GPU for copies of images [GB]; the others are streamed when they are needed",
    )
    pace: Literal["auto", "complete", "realtime"] = Field(
        default="auto",
        description="`complete`: every keyframe gets all its steps, however long they take; `realtime`: the work "
        "follows the arrival of the frames; `auto`: realtime for live frames and `source.realtime`, otherwise complete",
    )
    max_lag: float = Field(
        default=1.0,
        gt=0,
        description="longest time from a frame's arrival to the map that holds it, for `pace: realtime` [s]",
    )
    transients: bool = Field(default=False, description="mask what moves in keyframes, and score without it as well")
    clean: Literal["off", "auto"] = Field(
        default="off",
        description="`auto`: remove floaters, giants, needles and what no keyframe sees from the finished map, as far "
        "as that costs at most 0.05 dB (docs/output.md)",
    )
    gate: GateSettings = GateSettings()
    keyframes: KeyframeSettings = KeyframeSettings()
    densify: DensifySettings = DensifySettings()
    depth: DepthSettings = DepthSettings()
    voxels: VoxelSettings = VoxelSettings()
    levels: LevelSettings = LevelSettings()
    views: ViewSettings = ViewSettings()
    poses: PoseSettings = PoseSettings()
    corrections: CorrectionSettings = CorrectionSettings()
    exposure: ExposureSettings = ExposureSettings()
    optimise: OptimiseSettings = OptimiseSettings()

    @field_validator("max_gaussians")
    @classmethod
    def _the_engine_holds_them(cls, count: int) -> int:
        return engine().checked_pool(count, engine().max_gaussians)


class RefineSettings(StrictModel):
    """Post refinement of the finished map (Section 4.7).

    Example:
        mapper.refine(500, modp_ti.RefineSettings(views=2))
    """

    steps: int = Field(default=1000, ge=0, description="steps over all keyframes after the last frame; 0 for none")
    seconds: float | None = Field(
        default=None, gt=0, description="refine for this time [s] instead of `steps`; empty: `steps` counts"
    )
    views: int = Field(default=4, ge=1, description="views per step, drawn as the global views are")
    poses: bool = Field(default=False, description="also refine poses, at a rate that decays as that of positions does")
    hold: float = Field(
        default=0.0, ge=0, lt=1, description="share of it before rates decay; poses are refined in it, as in mapping"
    )
    position_decay: float = Field(
        default=0.01, gt=0, le=1, description="factor of the position rate at the end of the decay"
    )
    scale_decay: float = Field(default=0.1, gt=0, le=1, description="factor of the scale rate at the end of the decay")
    rate_decay: float = Field(
        default=0.1, gt=0, le=1, description="factor of the rates of rotation, opacity and colour at the end of it"
    )
    min_contribution: float = Field(
        default=0.5,
        ge=0,
        description="pixels covered where it shows most, below which a Gaussian is removed beforehand; 0 for none",
    )

    @property
    def wanted(self) -> bool:
        """Whether the finished map is refined at all."""
        return self.steps > 0 or self.seconds is not None


class OfflineSettings(StrictModel):
    """Offline 3DGS [Kerbl 2023], the baseline: optimisation on all frames, starting from the tracked points.

    An `extent` is 1.1 times the largest distance of a camera from the mean of all of them. Step numbers marked "of
    30,000" are those of the published run and scale with `steps`.
    """

    steps: int = Field(default=30_000, ge=1, description="optimisation steps, one view each")
    sh_degree: int = Field(default=3, ge=0, le=3, description="degree of the spherical harmonics of colour at the end")
    sh_every: int = Field(default=1000, ge=1, description="steps of 30,000 after which the degree rises by one")
    max_gaussians: int = Field(
        default=1_000_000,
        ge=1024,
        description="size of the pool; beyond it only the largest gradients grow. At most 1,000,000 with Taichi, "
        "33,554,432 with Quadrants",
    )
    near: float = Field(default=0.01, gt=0, description="nearest depth that is drawn [scene depths]")
    image_cache: float = Field(
        default=2.0,
        ge=0,
        description="memory of a GPU for copies of images [GB]; the others are streamed when they are needed",
    )
    initial_opacity: float = Field(default=0.1, gt=0, lt=1, description="opacity of a Gaussian at the start")
    ssim_weight: float = Field(default=0.2, ge=0, le=1, description="weight of 1 - SSIM beside L1")
    position_rate: float = Field(default=1.6e-4, ge=0, description="Adam step of positions at the start [extents]")
    position_decay: float = Field(
        default=0.01, gt=0, le=1, description="factor of the position rate at the end of the decay"
    )
    scale_rate: float = Field(default=5e-3, ge=0, description="Adam step of log-scales")
    rotation_rate: float = Field(default=1e-3, ge=0, description="Adam step of quaternions")
    opacity_rate: float = Field(default=0.05, ge=0, description="Adam step of opacity logits")
    colour_rate: float = Field(
        default=2.5e-3, ge=0, description="Adam step of the colour's constant harmonic; the others a twentieth"
    )
    densify_from: int = Field(
        default=500, ge=0, description="step after which Gaussians are cloned and split; at most a twelfth of the run"
    )
    densify_until: int = Field(default=15_000, ge=0, description="step of 30,000 at which that ends")
    densify_every: int = Field(default=100, ge=1, description="steps between; at most a twelfth of the run")
    gradient_threshold: float = Field(
        default=2e-4,
        gt=0,
        description="mean gradient by the mean's place in the image [half images] that clones or splits",
    )
    clone_size: float = Field(
        default=0.01, gt=0, description="longest axis up to which a Gaussian is cloned, not split [extents]"
    )
    prune_opacity: float = Field(default=0.005, ge=0, lt=1, description="opacity below which a Gaussian is removed")
    prune_size: float = Field(
        default=0.1, gt=0, description="longest axis above which it is, after the first reset of opacities [extents]"
    )
    reset_every: int = Field(
        default=3000, ge=1, description="steps of 30,000 between resets of all opacities, but 1,500 steps at least"
    )
    reset_opacity: float = Field(default=0.01, gt=0, lt=1, description="largest opacity after a reset")

    @field_validator("max_gaussians")
    @classmethod
    def _the_engine_holds_them(cls, count: int) -> int:
        return engine().checked_pool(count, engine().max_gaussians_offline)
