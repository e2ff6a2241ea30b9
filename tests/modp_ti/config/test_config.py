"""scene.yaml is read strictly, every mistake is named in one line, and what is written gives the same run."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path

import pytest
import yaml
from pydantic import ValidationError

from modp_ti.config.__main__ import reference
from modp_ti.config.keys import documented_keys, documented_values, dotted_keys, leaves, variants_of
from modp_ti.config.presets import PRESETS, with_defaults
from modp_ti.config.scene_file import dump_scene, load_scene, scene_from_data
from modp_ti.config.settings import EXCLUSIONS, SceneConfig, used_settings
from modp_ti.files.errors import InputError

KINDS = list(variants_of(SceneConfig.model_fields["tracker"]))
MINIMAL = "source: {path: images}\ntracker: {kind: colmap}\noutput: out/here\n"


@pytest.fixture
def scene(tmp_path: Path):
    def write(text: str = MINIMAL) -> Path:
        file = tmp_path / "scene.yaml"
        file.write_text(text)
        return file

    return write


def failure(path: Path, *overrides: str, preset: str | None = None) -> str:
    with pytest.raises(InputError) as caught:
        load_scene(path, overrides, preset)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_three_keys_are_enough_and_settings_cannot_be_changed_after_reading(scene):
    config = load_scene(scene())
    assert (config.source.scale, config.source.holdout, config.source.fps) == ("auto", None, 30.0)
    assert (config.seed, config.threads, config.tracker.path) == (0, None, None)
    assert load_scene(scene("tracker: {kind: socket}\noutput: o\n")).source.path is None
    with pytest.raises(ValidationError):
        config.seed = 3


@pytest.mark.parametrize(
    ("line", "wrong", "right"),
    [
        ("sorce: {path: x}", "sorce", "source"),
        ("sede: 3", "sede", "seed"),
        ("scale: 0.5", "scale", "source.scale"),
        (
            "mapping: {keyframes: {covisibilty: 0.9}}",
            "mapping.keyframes.covisibilty",
            "mapping.keyframes.covisibility",
        ),
        ("refine: {step: 3}", "refine.step", "refine.steps"),
    ],
)
def test_an_unknown_key_is_named_with_its_line_and_the_nearest_right_one(scene, line, wrong, right):
    message = failure(scene(MINIMAL + line + "\n"))
    assert "scene.yaml:4:" in message and f"`{wrong}`" in message and f"`{right}`?" in message


def test_a_key_unlike_any_other_lists_those_that_there_are(scene):
    message = failure(scene(MINIMAL + "qqq: 1\n"))
    assert all(key in message for key in ("qqq", *SceneConfig.model_fields))


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("source.scal=0.5", ["`source.scal`", "`source.scale`"]),
        ("scale=0.5", ["`scale`", "`source.scale`"]),
        ("mapping.keyframe.max_gap=3", ["`mapping.keyframe.max_gap`", "`mapping.keyframes.max_gap`"]),
        ("source={scal: 0.5}", ["`source.scal`", "`source.scale`"]),
        ("device.kind=cpu", ["`device.kind`"]),
        ("source.scale", ["section.key=value"]),
        ("=3", ["section.key=value"]),
        ("source.scale=2", ["source.scale", "not 2"]),
        ("seed=[1", ["YAML"]),
    ],
)
def test_a_wrong_override_is_named_as_it_was_typed(scene, override, parts):
    message = failure(scene(), override)
    assert all(part in message for part in (f"--set {override}", *parts))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("source.scale", value) for value in ("0", "1.5", '"0.5"', "true", ".nan", "1e999", "[0.5]", "half")),
        *(("source.mask_colour", value) for value in ("[0, 0]", "[0, 0, 256]", "[1, 2, x]")),
        *((key, "-1") for key in ("source.fps", "source.start", "source.holdout", "mapping.corrections.min_pixels")),
        *((key, "0") for key in ("source.step", "threads", "mapping.keyframes.max_gap")),
        *(("tracker.kind", value) for value in ("orb", "[colmap]", "null")),
        *((key, "7") for key in ("tracker", "mapping", "tracker.path", "tracker.adjust", "device", "view")),
        *(("seed", value) for value in ("-1", "null")),
        ("source.stream", "[1]"),
    ],
)
def test_a_wrong_value_is_refused_with_its_key_and_origin(scene, key, value):
    assert failure(scene(), f"{key}={value}").startswith(f"--set {key}={value}:")


@pytest.mark.parametrize(
    ("text", "overrides", "enabled"),
    [
        ("", (), False),
        ("view: {enabled: false, port: 9000}", (), False),
        ("view: true", (), True),
        ("view: {port: 9000}", (), True),
        ("", ("view.port=9000",), True),
        ("view: false", ("view.enabled=true",), True),
    ],
)
def test_the_viewer_is_asked_for_by_a_word_or_a_section_and_shows_to_this_machine(scene, text, overrides, enabled):
    view = load_scene(scene(f"{MINIMAL}{text}\n"), overrides).view
    assert (view.enabled, view.host) == (enabled, "127.0.0.1")
    assert view.port == (9000 if "9000" in text + str(overrides) else 8080)


def test_a_wrong_value_of_several_types_is_refused_in_one_sentence(scene):
    said = failure(scene("source:\n  path: images\n  scale: half\ntracker: {kind: colmap}\noutput: o\n"))
    assert said.endswith("scene.yaml:3: source.scale: must be 'auto' or a valid number, not \"half\"")


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        ("tracker: {kind: colmap}\noutput: o\n", "source.path"),
        ("source: {path: x}\noutput: o\n", "tracker.kind"),
        ("source: {path: x}\ntracker: {path: m}\noutput: o\n", "tracker.kind"),
        ("source: {path: x}\ntracker: {kind: colmap}\n", "output"),
        ("source: {kind: live}\ntracker: {kind: klt}\noutput: o\n", "source.stream"),
    ],
)
def test_a_missing_key_is_named_with_its_meaning(scene, text, missing):
    assert f"{missing} " in failure(scene(text)).replace(" is missing:", " ").replace(missing, f"{missing} ")


@pytest.mark.parametrize(
    ("tracker", "parts"),
    [
        ("{kind: colmap, pth: x}", ["`tracker.pth`", "`tracker.path`"]),
        ("{kind: colmap, points: x}", ["`tracker.points`", "replica", "colmap"]),
        ("{kind: colmap, adress: x}", ["`tracker.adress`", "`tracker.address`"]),
        ("{kind: klt, path: x}", ["`tracker.path`", "klt"]),
        ("{kind: tum, camera: x}", ["`tracker.camera`", "aria, bag"]),
        ("{kind: orbslam, path: x}", ["tracker.kind", "`orbslam3`"]),
        ("{kind: tum, max_difference: -1}", ["tracker.max_difference", "-1"]),
        ("{kind: tum, points: x, adjust: true}", ["tracker.adjust", "tracker.points"]),
        ("{kind: socket, address: x, path: y}", ["tracker.address", "tracker.path"]),
        ("{kind: synthetic, drift: 0.05}", ["tracker.kind", "synthetic"]),  # of version 0.1
    ],
)
def test_what_a_kind_of_tracker_does_not_take_is_named_with_its_line(scene, tracker, parts):
    message = failure(scene(f"source: {{path: x}}\noutput: o\ntracker: {tracker}\n"))
    assert all(part in message for part in ("scene.yaml:3: ", *parts))


def test_the_kind_that_counts_is_the_one_after_all_overrides(scene):
    tracker = load_scene(scene(), ["tracker.points=p.ply", "tracker.kind=tum"]).tracker
    assert (tracker.kind, attrgetter("points")(tracker)) == ("tum", Path.cwd() / "p.ply")
    assert load_scene(scene(), ["tracker.path=m", "tracker={kind: klt}"]).tracker.kind == "klt"
    assert failure(scene(), "tracker.path=m", "tracker.kind=klt").startswith("--set tracker.path=m: ")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("source: {path: x\ntracker: 3\n", "scene.yaml:2: "),
        ("source: x\n\tseed: 3\n", "scene.yaml:2: "),
        (MINIMAL + "seed: 1\nseed: 2\n", "scene.yaml:5: `seed`"),
        ("source:\n  path: a\n  path: b\n", "scene.yaml:3: `source.path`"),
        ("a: &a [*a]\n", "scene.yaml:1: "),
        ("", "scene.yaml: "),
        ("- 3\n", "scene.yaml: "),
        ("source: {path: x, start: 5, stop: 5}\ntracker: {kind: colmap}\noutput: o\n", "source.stop"),
    ],
)
def test_a_bad_file_is_named_with_its_line(scene, text, part):
    assert part in failure(scene(text))


def test_a_missing_scene_file_and_a_folder_are_named(tmp_path):
    for path in (tmp_path / "no.yaml", tmp_path):
        assert str(path) in failure(path)


def test_numbers_are_those_of_yaml_1_2(scene):
    config = load_scene(scene(), ["source.fps=3e1", "source.scale=5e-1", "seed=010"])
    assert (config.source.fps, config.source.scale, config.seed) == (30.0, 0.5, 10)


def test_overrides_win_over_the_file_and_later_ones_over_earlier_ones(scene):
    file = scene(MINIMAL + "seed: 1\n")
    assert load_scene(file, ["seed=2", "seed=3", "tracker.path=model"]).seed == 3
    assert load_scene(file, ["source.holdout=8", "source.holdout="]).source.holdout is None
    assert load_scene(file, ["mapping.keyframes.max_gap=9"]).mapping.keyframes.max_gap == 9


def test_what_is_typed_is_relative_to_the_shell_and_the_rest_to_the_file(scene, tmp_path, monkeypatch):
    file, shell = scene(MINIMAL + "onto: first\n"), tmp_path / "sh ell"
    shell.mkdir()
    monkeypatch.chdir(shell)
    there, here = file.resolve().parent, shell.resolve()
    plain = load_scene(file)
    assert (plain.source.path, plain.output, plain.onto) == (there / "images", there / "out/here", there / "first")
    typed = load_scene(file, ["output=there", "source.scale=0.5", "source.masks=../m", "tracker={kind: tum, path: p}"])
    assert (typed.output, typed.source.masks) == (here / "there", tmp_path.resolve() / "m")
    assert (attrgetter("path")(typed.tracker), typed.source.path) == (here / "p", there / "images")
    assert load_scene(file, ["output=~/there"]).output == (Path.home() / "there").resolve()
    dump_scene(typed, there / "config.yaml")
    monkeypatch.chdir("/")
    assert load_scene(there / "config.yaml") == typed


@pytest.mark.parametrize("kind", KINDS)
def test_a_written_scene_gives_the_same_run_with_the_keys_of_its_own_tracker_alone(scene, kind, tmp_path, monkeypatch):
    config = load_scene(scene(), [f"tracker={{kind: {kind}}}", "source.holdout=8", "threads=2"])
    (elsewhere := tmp_path / "deep" / "er").mkdir(parents=True)
    monkeypatch.chdir("/")
    dump_scene(config, elsewhere / "config.yaml")
    assert load_scene(elsewhere / "config.yaml") == config
    data = yaml.safe_load((elsewhere / "config.yaml").read_text())
    assert list(leaves(data)) == [entry.key for entry in documented_keys(SceneConfig) if entry.variant in ("", kind)]
    assert scene_from_data(data, "snapshot.npz") == config
    values = {entry.key: value for entry, value in documented_values(config)}
    assert list(values) == list(leaves(data)) and (values["tracker.kind"], values["threads"]) == (kind, 2)


def test_the_reference_has_every_key_and_is_up_to_date():
    page = (Path(__file__).resolve().parents[3] / "docs" / "configuration.md").read_text()
    assert page == reference(), "run: python -m modp_ti.config > docs/configuration.md"
    for entry in documented_keys(SceneConfig):
        assert entry.description, f"{entry.key} has no description"
        assert f"| `{entry.variant}` | {entry.description} |" if entry.selects else f"| `{entry.key}` |" in page
    assert "| `refine.steps` | `1000` | `200` | `3000` |" in page


@pytest.mark.parametrize(
    ("given", "size", "scale"),
    [
        ("auto", (1920, 1080), 0.25),
        ("auto", (1080, 1920), 0.25),
        ("auto", (640, 480), 0.75),
        ("auto", (80, 60), 1.0),
        ("0.5", (1920, 1080), 0.5),
    ],
)
def test_the_scale_is_chosen_from_the_size_of_the_images_unless_it_is_given(scene, given, size, scale):
    config = load_scene(scene(), [f"source.scale={given}"])
    assert config.source.scale_for(*size) == scale
    assert config.resolved(0.125).source.scale == (0.125 if given == "auto" else 0.5)


@pytest.mark.parametrize(
    ("text", "realtime"),
    [
        ("source: {path: images}\ntracker: {kind: klt}", False),
        ("source: {path: images, realtime: true}\ntracker: {kind: klt}", True),
        ("source: {stream: 0}\ntracker: {kind: klt}", True),
        ("tracker: {kind: socket}", True),
        ("source: {stream: 0}\ntracker: {kind: klt}\nmapping: {pace: complete}", False),
        ("source: {path: images}\ntracker: {kind: klt}\nmapping: {pace: realtime}", True),
        ("source: {path: images}\ntracker: {kind: klt}\nmapping: {pace: realtime}\nmode: offline", False),
    ],
)
def test_live_frames_set_the_pace_unless_the_scene_says_otherwise(scene, text: str, realtime: bool) -> None:
    config = load_scene(scene(f"{text}\noutput: out\n"))
    assert config.is_realtime is realtime
    assert not (config.is_realtime and config.can_be_resumed)


# A way to set each setting that excludes another; after the others, since a tracker's kind replaces the section.
WAYS = {
    "source.path": "source.path=images",
    "source.kind": "source.kind=video",
    "source.stream": "source.stream=0",
    "source.realtime": "source.realtime=true",
    "source.intrinsics": "source.intrinsics.fx=500",
    "source.masks": "source.masks=masks",
    "source.vignette": "source.vignette=light.png",
    "source.panorama": "source.panorama.projection=equirectangular",
    "source.part": "source.part=[0, 9]",
    "tracker.maps": "tracker={kind: klt, maps: largest}",
    "tracker.maps: all": "tracker={kind: klt, maps: all}",
    "tracker.adjust": "tracker={kind: tum, adjust: true}",
    "a tracker of images as they come": "tracker={kind: klt}",
    "a tracker of recordings": "tracker={kind: colmap}",
    "a tracker with cameras": "tracker={kind: colmap}",
    "a tracker without panoramas": "tracker={kind: klt}",
    "a live tracker": "tracker={kind: socket}",
    "mapping.pace: realtime": "mapping.pace=realtime",
    "mode: offline": "mode=offline",
    "snapshot_every": "snapshot_every=9",
    "minutes": "minutes=1",
    "refine.seconds": "refine.seconds=9",
    "onto": "onto=first",
    "parts": "parts=2",
}


@pytest.mark.parametrize(("key", "other"), [(key, other) for key, others, _ in EXCLUSIONS for other in others])
def test_what_excludes_each_other_is_refused_with_both_and_each_alone_is_taken(scene, key, other):
    base = {"source.stream": "{stream: 0}"}.get(key, "{path: images}")
    given = sorted((WAYS[key], WAYS[other]), key=lambda way: way.startswith("tracker"))
    followed = key in ("source.stream", "source.realtime") or key.startswith("tracker.maps")
    tracker = "klt" if followed else "sfm" if "panorama" in key else "tum"
    file = scene(f"source: {base}\ntracker: {{kind: {tracker}}}\noutput: o\n")
    message = failure(file, *given)
    assert "cannot be combined" in message
    config = load_scene(file, [WAYS[key]])
    assert key in used_settings(config), "a setting is not recognised as used"


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_sets_its_keys_where_nobody_else_does(scene, preset: str) -> None:
    plain, changed = (leaves(load_scene(scene(), preset=name).model_dump()) for name in (None, preset))
    settings = PRESETS[preset].settings
    assert {key: changed[key] for key in changed if changed[key] != plain[key]} == settings
    for key in ("mapping.optimise.steps", "refine.steps"):
        assert (settings[key] < plain[key]) == (preset == "fast")
    file = scene(MINIMAL + "mapping: {optimise: {steps: 7}, sh_degree: 2}\n")
    config = load_scene(file, ["refine.steps=11"], preset)
    assert (config.mapping.optimise.steps, config.refine.steps, config.mapping.sh_degree) == (7, 11, 2)
    given = {"mapping": {"optimise": {"steps": 7}}}
    assert with_defaults(given, settings)["refine"] and given == {"mapping": {"optimise": {"steps": 7}}}
    assert "scene.yaml:4: mapping" in failure(scene(MINIMAL + "mapping: 7\n"), preset=preset)
    assert "slow" in failure(scene(), preset="slow")


def test_every_section_can_be_set_as_a_whole(scene) -> None:
    sections = [key for key in dotted_keys(documented_keys(SceneConfig)) if key == "mapping" or key.count(".") == 1]
    assert "mapping.densify" in sections
    assert load_scene(scene(), ["mapping.densify={}", "mapping={sh_degree: 2}"]).mapping.sh_degree == 2
