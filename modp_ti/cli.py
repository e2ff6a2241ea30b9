"""The command `modp-ti`: one subcommand a job."""

from __future__ import annotations

import typer

from modp_ti.check import check
from modp_ti.export import export
from modp_ti.render import render
from modp_ti.run import run
from modp_ti.view import view
from modp_ti.warmup import warmup

__all__ = ["app"]

app = typer.Typer(
    name="modp-ti",
    help="Photorealistic 3D Gaussian maps from one RGB camera, built while the frames arrive.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command("run")(run)
app.command("check")(check)
app.command("render")(render)
app.command("export")(export)
app.command("view")(view)
app.command("warmup")(warmup)


if __name__ == "__main__":
    app()
