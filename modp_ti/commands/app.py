"""The command `modp-ti` with its subcommands."""

from __future__ import annotations

from typing import Annotated

import typer

from fields.runtime.engine import EngineError, engine
from modp_ti.commands import batch, edit, finished, input, run
from modp_ti.commands.shared import BAD_INPUT, MARKUP, CommandGroup, examples
from modp_ti.version import __version__

OVERVIEW = examples(
    "modp-ti check scene.yaml   (is the input as it should be?)",
    "modp-ti run scene.yaml   (the map, its poses, figures and report.html)",
    "modp-ti run room.mp4   (the same without a scene file)",
    "modp-ti batch */scene.yaml   (many recordings)",
    "modp-ti refine OUT   (a finished map, by several processes)",
    "modp-ti clean OUT   (without floaters, in OUT-clean)",
    "modp-ti render OUT --path orbit   (OUT: the output folder of a run)",
    "modp-ti export OUT --format html",
    "modp-ti locate OUT new.jpg",
)
ENDS = (
    "Exit codes: 0 done; 1 (check) usable, with warnings; 1 (batch) a scene is not finished; 1 (locate) a picture was "
    "not located; 2 wrong input or options; 3 a fault of the program; 130 interrupted (129 by SIGHUP, 143 by SIGTERM)."
)

app = typer.Typer(
    name="modp-ti",
    cls=CommandGroup,
    rich_markup_mode=MARKUP,
    help="Photorealistic 3D Gaussian maps from one RGB camera, built while the frames arrive.",
    epilog=f"{OVERVIEW}\n\n{ENDS}",
    pretty_exceptions_enable=False,
)


def _print_version(asked: bool) -> None:
    if asked:
        try:
            compiler = engine()
        except EngineError as error:
            compiler = error
        typer.echo(f"modp-ti {__version__} ({compiler})")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="print the version and end")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit(BAD_INPUT)


EXAMPLES = {"run": run.EXAMPLES, "batch": batch.EXAMPLES, **finished.EXAMPLES, **edit.EXAMPLES, **input.EXAMPLES}
for command in (
    *(run.run, batch.batch, finished.refine, edit.clean, edit.crop, edit.scale, input.cameras, input.check),
    *(finished.render, finished.export, finished.measure, finished.locate, finished.view, input.warmup),
):
    app.command(epilog=EXAMPLES[command.__name__])(command)


if __name__ == "__main__":
    app()
