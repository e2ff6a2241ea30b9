"""The settings of what follows a run's map: its evaluation, optional output files, and the live viewer."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, model_validator

from pipelines.settings import StrictModel


class EvaluationSettings(StrictModel):
    """The evaluation of the finished map."""

    scores: bool = Field(
        default=True, description="score all frames with the finished map; false: `metrics.json` has no scores"
    )
    lpips_weights: Path | None = Field(
        default=None,
        description="folder with `alexnet-owt-7be5be79.pth` (torchvision) and `alex.pth` (the `lpips` package, v0.1); "
        "empty: they are searched in torch's cache and in the installed package. Without them, LPIPS is null",
    )


class ExportSettings(StrictModel):
    """Optional output files of a run."""

    images: bool = Field(
        default=False,
        description="write the undistorted images to `colmap/images`. The cameras in `colmap/` belong to these images, "
        "so other programs need them",
    )
    session: bool = Field(
        default=False,
        description="write `session.zip`, all that arrived in a realtime or timed run and what was decided by the "
        "clock, with which `modp-ti run --replay OUT` repeats it exactly",
    )
    report: bool = Field(
        default=True, description="write `report.html`, a page with the metrics, plots, images and settings of the run"
    )


class ViewSettings(StrictModel):
    """The live viewer."""

    enabled: bool = Field(
        default=False,
        description="serve a web page that shows the growing map (docs/viewer.md). `view: true` is a short form, and "
        "setting any other key of this section enables the viewer too",
    )
    host: str = Field(
        default="127.0.0.1",
        description="address to listen at: 127.0.0.1 is reachable only from this machine, 0.0.0.0 from the network",
    )
    port: int = Field(
        default=8080,
        ge=0,
        le=65535,
        description="port of the server; if it is in use, the next free one; 0: any free port",
    )
    paused: bool = Field(
        default=False, description="pause after the first frame until the run is continued in the browser"
    )
    max_cost: float = Field(
        default=5.0,
        gt=0,
        le=100,
        description="largest share of the mapping time [%] that the viewer uses; it updates less often instead",
    )
    max_splats: int = Field(
        default=100_000,
        ge=100,
        description="largest number of splats in the browser. Of a larger map, a subset with enlarged splats is shown",
    )

    @model_validator(mode="before")
    @classmethod
    def _short_form(cls, given: object) -> object:
        if isinstance(given, bool):
            return {"enabled": given}
        if isinstance(given, dict) and given and "enabled" not in given:
            return {"enabled": True, **given}
        return given
