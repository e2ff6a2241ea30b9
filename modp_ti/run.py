"""The main job: `python -m modp_ti.run scene.yaml [--set key=value ...]`, the same as `modp-ti run`."""

from modp_ti.commands.run import EXAMPLES, run
from modp_ti.commands.shared import standalone

if __name__ == "__main__":
    standalone(run, EXAMPLES)
