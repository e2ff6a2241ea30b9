"""The command `modp-ti`: one subcommand a job."""

from __future__ import annotations

import typer

from modp_ti.run import run

__all__ = ["app"]

app = typer.Typer(
    name="modp-ti",
    help="Photorealistic 3D Gaussian maps from one RGB camera, built while the frames arrive.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command("run")(run)


@app.callback()
def _subcommands() -> None:
    """Makes `run` a subcommand although it is, so far, the only one."""


if __name__ == "__main__":
    app()
