"""`python -m modp_ti.config` prints the documentation of every key and of the presets as Markdown."""

from modp_ti.config.keys import markdown_of_keys
from modp_ti.config.presets import markdown_of_presets
from modp_ti.config.settings import SceneConfig

if __name__ == "__main__":
    print(markdown_of_keys(SceneConfig) + "\n" + markdown_of_presets(), end="")
