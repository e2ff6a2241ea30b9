"""scene.yaml is read strictly, every mistake is named in one line, and what is written gives the same run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from pydantic import ValidationError

from modp_ti.config.keys import documented_keys, documented_values, markdown_of_keys, variants_of
from modp_ti.config.presets import markdown_of_presets
from modp_ti.config.scene_file import dump_scene, load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.config.tracker_settings import KltSettings, TumSettings
from modp_ti.files.errors import InputError

KINDS = list(variants_of(SceneConfig.model_fields["tracker"]))
MINIMAL = "source: {path: images}\ntracker: {kind: colmap}\noutput: out/here\n"


@pytest.fixture
def scene(tmp_path: Path):
    def write(text: str) -> Path:
        file = tmp_path / "scene.yaml"
        file.write_text(text)
        return file

    return write


def failure(path: Path, *overrides: str) -> str:
    with pytest.raises(InputError) as caught:
        load_scene(path, overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_three_keys_are_enough_and_paths_are_relative_to_the_file(scene, tmp_path, monkeypatch):
    file = scene(MINIMAL)
    monkeypatch.chdir("/")
    config = load_scene(file)
    assert config.source.path == (tmp_path / "images").resolve()
    assert config.output == (tmp_path / "out" / "here").resolve()
    assert (config.source.scale, config.source.holdout, config.source.fps) == ("auto", None, 30.0)
    assert (config.seed, config.threads, config.tracker.path) == (0, None, None)


def test_settings_cannot_be_changed_after_reading(scene):
    config = load_scene(scene(MINIMAL))
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
def test_unknown_key_is_named_with_its_place_its_line_and_the_nearest_right_one(scene, line, wrong, right):
    message = failure(scene(MINIMAL + line + "\n"))
    assert "scene.yaml:4:" in message
    assert f"unknown key `{wrong}`" in message
    assert f"did you mean `{right}`?" in message


def test_unknown_key_in_a_written_section_is_compared_with_that_section(scene):
    message = failure(scene("source:\n  path: x\n  hold_out: 8\ntracker: {kind: colmap}\noutput: o\n"))
    assert "scene.yaml:3: unknown key `source.hold_out`; did you mean `source.holdout`?" in message


def test_key_unlike_any_other_lists_those_that_there_are(scene):
    message = failure(scene(MINIMAL + "qqq: 1\n"))
    assert "unknown key `qqq`" in message
    for key in SceneConfig.model_fields:
        assert key in message


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("source.scal=0.5", ["unknown key `source.scal`", "`source.scale`"]),
        ("scale=0.5", ["unknown key `scale`", "`source.scale`"]),
        ("mapping.keyframe.max_gap=3", ["unknown key `mapping.keyframe`", "`mapping.keyframes.max_gap`"]),
        ("source={scal: 0.5}", ["unknown key `source.scal`", "`source.scale`"]),
        ("device.kind=cpu", ["`device` is a value"]),
        ("source.scale", ["section.key=value"]),
        ("=3", ["section.key=value"]),
        ("source.scale=2", ["source.scale", "less than or equal to 1", "not 2"]),
        ("seed=[1", ["not valid YAML"]),
    ],
)
def test_wrong_override_is_named_as_it_was_typed(scene, override, parts):
    message = failure(scene(MINIMAL), override)
    assert f"--set {override}" in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("source.scale", "0"),
        ("source.scale", "1.5"),
        ("source.scale", '"0.5"'),
        ("source.scale", "true"),
        ("source.scale", ".nan"),
        ("source.scale", "1e999"),
        ("source.scale", "[0.5]"),
        ("source.holdout", "1"),
        ("source.holdout", "2.5"),
        ("source.fps", "-1"),
        ("source.start", "-1"),
        ("source.step", "0"),
        ("source.mask_colour", "[0, 0]"),
        ("source.mask_colour", "[0, 0, 256]"),
        ("source.mask_tolerance", "-1"),
        ("tracker.exposure_change", "1"),
        ("tracker.drift", "0.05"),
        ("tracker.correction", "true"),
        ("tracker.adjust", "true"),
        ("tracker.max_points", "3000"),
        ("mapping.corrections.min_pixels", "-1"),
        ("tracker.kind", "orb"),
        ("tracker.path", "3"),
        ("device", "gpu"),
        ("seed", "-1"),
        ("seed", "null"),
        ("threads", "0"),
        ("mapping", "7"),
        ("mapping.keyframes.max_gap", "0"),
    ],
)
def test_wrong_value_is_refused_with_its_key(scene, key, value):
    assert key in failure(scene(MINIMAL), f"{key}={value}")


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("source.scale=7", "source.scale: must be less than or equal to 1, not 7"),
        ("source.scale=half", "source.scale: must be 'auto' or a valid number, not \"half\""),
        ("source.stream=[1]", "source.stream: must be a valid integer or a valid string, not [1]"),
        ("source.mask_colour=[1, 2, x]", 'source.mask_colour.2: must be a valid integer, not "x"'),
        ("mapping.exposure.enabled=3", "mapping.exposure.enabled: must be a valid boolean, not 3"),
    ],
)
def test_value_of_several_types_is_refused_in_one_sentence(scene, override, said):
    assert failure(scene(MINIMAL), override).endswith(f": {said}")


@pytest.mark.parametrize(
    ("given", "size", "scale"),
    [
        ("auto", (1920, 1080), 0.25),
        ("auto", (1080, 1920), 0.25),
        ("auto", (640, 480), 0.75),
        ("auto", (480, 270), 1.0),
        ("auto", (80, 60), 1.0),
        ("0.5", (1920, 1080), 0.5),
        ("1", (1920, 1080), 1.0),
    ],
)
def test_scale_is_chosen_from_the_size_of_the_images_unless_it_is_given(scene, given, size, scale):
    config = load_scene(scene(MINIMAL), [f"source.scale={given}"])
    assert config.source.scale_for(*size) == scale


def test_resolved_settings_hold_a_number_for_the_scale(scene):
    config = load_scene(scene(MINIMAL))
    assert config.resolved(0.25).source.scale == 0.25
    assert config.resolved(0.25).model_copy(update={"source": config.source}) == config
    assert load_scene(scene(MINIMAL), ["source.scale=0.5"]).resolved(0.25).source.scale == 0.5


def test_wrong_value_in_the_file_is_named_with_its_line(scene):
    message = failure(scene("source:\n  path: images\n  scale: 3\ntracker: {kind: colmap}\noutput: o\n"))
    assert "scene.yaml:3: source.scale: must be less than or equal to 1, not 3" in message


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("tracker: {kind: colmap}\noutput: o\n", ["source.path is missing"]),
        ("source: {path: x}\noutput: o\n", ["tracker is missing", "tracker.kind"]),
        ("source: {path: x}\ntracker: {}\noutput: o\n", ["tracker.kind is missing", "`klt` (the built-in tracker"]),
        ("source: {path: x}\ntracker: {path: m}\noutput: o\n", ["tracker.kind is missing"]),
        ("source: {path: x}\ntracker: {kind: colmap}\n", ["output is missing", "output folder"]),
    ],
)
def test_missing_key_is_named_with_its_meaning(scene, text, parts):
    message = failure(scene(text))
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("tracker", "parts"),
    [
        ("{kind: colmap, pth: x}", ["unknown key `tracker.pth`; did you mean `tracker.path`?"]),
        (
            "{kind: colmap, points: x}",
            [
                "unknown key `tracker.points`",
                "replica, matrices, tanksandtemples, sevenscenes and bag, not colmap",
                "`tracker.path`",
            ],
        ),
        (
            "{kind: klt, path: x}",
            ["unknown key `tracker.path`", "not klt, which has `tracker.loops`, `tracker.maps`; take it out"],
        ),
        ("{kind: tum, camera: x}", ["`tracker.camera`: it is for tracker.kind: aria and bag, not tum"]),
        ("{kind: replica, time_offset: 1}", ["`tracker.time_offset`"]),
        ("{kind: colmap, adress: x}", ["did you mean `tracker.address`, which is for tracker.kind: socket?"]),
        ("{points: x, pth: y}", ["unknown key `tracker.pth`; did you mean `tracker.path`?"]),
        ("{kind: orbslam, path: x}", ["tracker.kind: must be 'colmap', 'transforms'", "did you mean `orbslam3`?"]),
        ("{kind: [colmap]}", ["tracker.kind: must be", 'not ["colmap"]']),
        ("{kind: }", ["tracker.kind: must be", "not null"]),
        ("7", ["tracker: must be an object, not 7"]),
        ("{kind: tum, max_difference: -1}", ["tracker.max_difference: must be greater than 0, not -1"]),
        ("{kind: tum, points: x, adjust: true}", ["tracker.adjust cannot be used with tracker.points"]),
        ("{kind: socket, address: x, path: y}", ["tracker.address and tracker.path cannot both be set"]),
    ],
)
def test_what_a_kind_of_tracker_does_not_take_is_named_with_its_line(scene, tracker, parts):
    message = failure(scene(f"source: {{path: x}}\noutput: o\ntracker: {tracker}\n"))
    assert "scene.yaml:3: " in message
    for part in parts:
        assert part in message


def test_the_kind_that_counts_is_the_one_after_all_overrides(scene):
    file = scene(MINIMAL)
    tracker = load_scene(file, ["tracker.points=p.ply", "tracker.kind=tum"]).tracker
    assert isinstance(tracker, TumSettings) and tracker.points == Path.cwd() / "p.ply"
    assert isinstance(load_scene(file, ["tracker.path=m", "tracker={kind: klt}"]).tracker, KltSettings)
    message = failure(file, "tracker.path=m", "tracker.kind=klt")
    assert message.startswith("--set tracker.path=m: unknown key `tracker.path`")


def test_empty_range_of_frames_is_refused(scene):
    assert "source.stop (5) must be larger than source.start (5)" in failure(
        scene(MINIMAL), "source.start=5", "source.stop=5"
    )


def test_socket_tracker_needs_no_images(scene):
    assert load_scene(scene("tracker: {kind: socket}\noutput: o\n")).source.path is None


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("source: {path: x\ntracker: 3\n", "scene.yaml:2: not valid YAML"),
        ("source: x\n\tseed: 3\n", "scene.yaml:2: not valid YAML"),
        (MINIMAL + "seed: 1\nseed: 2\n", "scene.yaml:5: `seed` stands twice (first in line 4)"),
        ("source:\n  path: a\n  path: b\n", "scene.yaml:3: `source.path` stands twice"),
        ("a: &a [*a]\n", "alias"),
        ("", "holds none"),
        ("- 3\n", "holds none"),
    ],
)
def test_bad_yaml_is_named_with_its_line(scene, text, part):
    assert part in failure(scene(text))


def test_missing_scene_file_is_named(tmp_path):
    assert failure(tmp_path / "no.yaml") == f"{tmp_path / 'no.yaml'}: no such scene file"
    assert "cannot be read" in failure(tmp_path)


def test_numbers_are_those_of_yaml_1_2(scene):
    config = load_scene(scene(MINIMAL), ["source.fps=3e1", "source.scale=5e-1", "seed=010"])
    assert (config.source.fps, config.source.scale, config.seed) == (30.0, 0.5, 10)


def test_overrides_win_over_the_file_and_later_ones_over_earlier_ones(scene):
    file = scene(MINIMAL + "seed: 1\n")
    assert load_scene(file, ["seed=2", "seed=3", "tracker.path=model"]).seed == 3
    assert load_scene(file, ["source.holdout=8", "source.holdout="]).source.holdout is None
    assert load_scene(file, ["mapping.keyframes.max_gap=9"]).mapping.keyframes.max_gap == 9


def test_what_is_typed_is_relative_to_the_shell_and_the_rest_to_the_file(scene, tmp_path, monkeypatch):
    file, shell = scene(MINIMAL), tmp_path / "sh ell"
    shell.mkdir()
    monkeypatch.chdir(shell)
    there, here = file.resolve().parent, shell.resolve()
    plain = load_scene(file)
    assert (plain.source.path, plain.output) == (there / "images", there / "out/here")
    typed = load_scene(file, ["output=there", "source.scale=0.5", "source.masks=../m", "tracker={kind: tum, path: p}"])
    assert (typed.output, typed.source.masks, typed.tracker.path) == (
        here / "there",
        tmp_path.resolve() / "m",
        here / "p",
    )
    assert typed.source.path == there / "images", "the rest of a section is the file's"
    assert load_scene(file, ["output=~/there"]).output == (Path.home() / "there").resolve()
    assert load_scene(file, ["tracker.kind=tum", "tracker.path=/p"]).tracker.path == Path("/p").resolve()
    dump_scene(typed, there / "config.yaml")
    monkeypatch.chdir("/")
    assert load_scene(there / "config.yaml") == typed


def test_written_configuration_gives_the_same_run_from_wherever_it_lies(scene, tmp_path, monkeypatch):
    config = load_scene(
        scene(MINIMAL),
        ["source.scale=0.3", "source.holdout=8", "tracker.path=a b/0", "threads=2", "mapping.sh_degree=1"],
    )
    elsewhere = tmp_path / "deep" / "er"
    elsewhere.mkdir(parents=True)
    monkeypatch.chdir("/")
    dump_scene(config, elsewhere / "config.yaml")
    assert load_scene(elsewhere / "config.yaml") == config
    assert [file.name for file in elsewhere.iterdir()] == ["config.yaml"]


def test_a_scene_is_written_with_the_keys_of_its_own_tracker_alone(scene, tmp_path):
    for kind in KINDS:
        dump_scene(load_scene(scene(MINIMAL), [f"tracker={{kind: {kind}}}"]), tmp_path / "config.yaml")
        written = leaves(yaml.safe_load((tmp_path / "config.yaml").read_text()))
        assert written == [entry.key for entry in documented_keys(SceneConfig) if entry.variant in ("", kind)]
        assert load_scene(tmp_path / "config.yaml").tracker.kind == kind


def leaves(data: dict, prefix: str = "") -> list[str]:
    keys = []
    for key, value in data.items():
        keys += leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else [prefix + key]
    return keys


def test_every_key_is_documented_with_its_meaning_and_default():
    text = markdown_of_keys(SceneConfig)
    for entry in documented_keys(SceneConfig):
        assert entry.description, f"{entry.key} has no description"
        assert f"| `{entry.key}` |" in text
    defaults = {entry.key: entry.default for entry in documented_keys(SceneConfig)}
    assert (defaults["source.scale"], defaults["source.holdout"], defaults["output"]) == ('"auto"', "", None)
    assert (defaults["tracker.kind"], defaults["tracker.patience"]) == (None, "120.0")


def test_every_kind_of_tracker_has_its_section_in_the_reference():
    text = markdown_of_keys(SceneConfig)
    for kind in KINDS:
        section = text.split(f"### `tracker` of kind `{kind}`\n")[1].split("\n#")[0]
        keys = [entry.key for entry in documented_keys(SceneConfig) if entry.variant == kind]
        assert re.findall(r"^\| `([\w.]+)` \|", section, re.MULTILINE) == keys
        assert f"| [`{kind}`](#tracker-of-kind-{kind}) |" in text


def test_every_setting_is_told_with_its_value(scene):
    config = load_scene(scene(MINIMAL), ["tracker={kind: aria, camera: left}", "seed=4"])
    values = {entry.key: value for entry, value in documented_values(config)}
    assert (values["tracker.kind"], values["tracker.camera"], values["seed"]) == ("aria", "left", 4)
    entries = [entry for entry in documented_keys(SceneConfig) if entry.variant in ("", "aria")]
    assert [entry for entry, _ in documented_values(config)] == entries


def test_reference_of_the_keys_is_up_to_date():
    page = Path(__file__).resolve().parents[3] / "docs" / "configuration.md"
    reference = markdown_of_keys(SceneConfig) + "\n" + markdown_of_presets()
    assert page.read_text() == reference, "run: python -m modp_ti.config > docs/configuration.md"


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


@pytest.mark.parametrize("source", ["{stream: 0}", "{path: images, realtime: true}"])
def test_the_largest_map_of_images_that_follow_a_clock_cannot_be_waited_for(scene, source: str) -> None:
    text = failure(scene(f"source: {source}\ntracker: {{kind: klt, maps: largest}}\noutput: out\n"))
    assert "tracker.maps: largest needs all images before the first is mapped" in text


def test_a_realtime_run_has_no_snapshots(scene) -> None:
    text = failure(scene(MINIMAL), "mapping.pace=realtime", "snapshot_every=10")
    assert "snapshot_every is for `mapping.pace: complete`; remove one of them" in text


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("mode=offline", "onto is for mode: online, not offline; remove one of them"),
        ("mapping.pace=realtime", "onto needs frames that wait while they are located"),
        ("tracker={kind: socket}", "onto needs frames that wait while they are located"),
    ],
)
def test_a_run_that_goes_on_with_another_map_waits_for_no_clock(scene, override: str, said: str) -> None:
    assert said in failure(scene(MINIMAL), "onto=first", override)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("tracker={kind: colmap}", "tracker.kind: colmap has no poses of panoramas; take klt, transforms"),
        ("tracker={kind: klt, loops: true}", "klt follows panoramas in one map, without loops"),
        ("tracker={kind: klt, maps: largest}", "klt follows panoramas in one map, without loops"),
        ("tracker={kind: tum, adjust: true}", "tracker.adjust would move the faces apart"),
        ("onto=out/other", "onto is not for panoramas"),
        ("mapping.pace=realtime", "mapping.pace: realtime is not for panoramas"),
        ("source.panorama.projection=none", "source.panorama.projection is missing"),
    ],
)
def test_what_panoramas_cannot_be_combined_with_is_named(scene, override: str, said: str) -> None:
    panorama = "panorama: {projection: equirectangular, faces: 6}"
    file = scene(f"source: {{path: images, {panorama}}}\ntracker: {{kind: klt}}\noutput: out/here\n")
    assert load_scene(file).source.panorama.count == 6
    assert said in failure(file, override)


def test_the_run_to_go_on_with_is_relative_to_the_scene_file(scene) -> None:
    file = scene(MINIMAL + "onto: first\n")
    assert load_scene(file).onto == (file.parent / "first").resolve()
