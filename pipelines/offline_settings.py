"""Settings of the offline baseline."""

from __future__ import annotations

from pydantic import Field, field_validator

from fields.runtime.engine import engine
from pipelines.settings import StrictModel


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
