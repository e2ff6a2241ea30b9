"""The scenes of a batch: each with an output folder and a storage; and what counts as a finished run of one."""

from __future__ import annotations

from pathlib import Path

import pytest

from modp_ti.config.scene_file import dump_scene, load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.many.batch import SNAPSHOT_EVERY, read_scenes, with_resources, with_store
from modp_ti.many.pool import Resources
from modp_ti.outputs.playback.finished_run import finished_metrics

SCENE = "source: {path: images}\ntracker: {kind: colmap}\noutput: OUT\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def scene(file: Path, output: str, more: str = "") -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(SCENE.replace("OUT", output) + more)
    return file


def test_what_cannot_be_read_does_not_hinder_the_others(folder: Path) -> None:
    good, bad = scene(folder / "good.yaml", "maps/good"), scene(folder / "bad.yaml", "maps/bad", "nonsense: 1\n")
    (folder / "live.yaml").write_text("source: {stream: 0}\ntracker: {kind: klt}\noutput: live\n")
    scenes = read_scenes([good, folder / "gone.yaml", bad, folder / "live.yaml", good, folder / "." / "good.yaml"])
    assert [scene.name for scene in scenes] == ["good", "gone.yaml", "bad.yaml", "live.yaml"]
    assert [scene.config is not None for scene in scenes] == [True, False, False, False]
    assert all(scene.error and "\n" not in scene.error for scene in scenes[1:])


def test_no_two_scenes_have_a_name_or_a_folder_in_common(folder: Path) -> None:
    files = [scene(folder / name / "scene.yaml", "out") for name in ("a", "b", "c")]
    assert [scene.name for scene in read_scenes(files)] == ["out", "out-2", "out-3"]
    first, second = scene(folder / "a.yaml", "maps/x"), scene(folder / "b.yaml", "maps/x")
    scenes = read_scenes([first, second])
    assert scenes[1].config is None and str(first) in scenes[1].error


def test_recordings_of_one_name_get_folders_of_their_own_and_keep_them(folder: Path) -> None:
    videos = [folder / name / "walk.mp4" for name in ("monday", "tuesday")]
    for video in videos:
        video.parent.mkdir()
        video.touch()

    def outputs() -> list[Path]:
        return [scene.config.output for scene in read_scenes(videos) if scene.config is not None]

    expected = [folder / "out" / "walk", folder / "out" / "walk-2"]
    assert outputs() == expected
    expected[1].mkdir(parents=True)  # the second is finished, the first is not
    (expected[1] / "config.yaml").write_text(
        f"source: {{path: {videos[1]}}}\ntracker: {{kind: klt}}\noutput: {expected[1]}\n"
    )
    assert outputs() == expected


@pytest.mark.parametrize(
    ("more", "every"),
    [
        ("", SNAPSHOT_EVERY),
        ("snapshot_every: 7\n", 7),
        ("mode: offline\n", None),
        ("snapshot_every: 0\n", 0),
        ("view: true\n", SNAPSHOT_EVERY),
    ],
)
def test_scenes_are_saved_on_the_way_where_they_can_be_resumed(folder: Path, more: str, every: int | None) -> None:
    (read,) = read_scenes([scene(folder / "a.yaml", "a", more)])
    config = read.config
    assert config is not None and config.snapshot_every == every and not config.view.enabled


@pytest.mark.parametrize(
    ("more", "resources", "expected"),
    [
        ("", Resources(3.0), (3, "cpu")),
        ("", Resources(0.5, 0.5), (1, "auto")),
        ("threads: 2\n", Resources(3.0, 1.0), (2, "auto")),
    ],
)
def test_a_process_has_the_threads_and_the_device_that_were_asked_for(
    folder: Path, more: str, resources: Resources, expected: tuple[int, str]
) -> None:
    given = with_resources(load_scene(scene(folder / "a.yaml", "a", more)), resources)
    assert (given.threads, given.device) == expected


def test_the_storage_of_a_scene_does_not_depend_on_the_others(folder: Path) -> None:
    files = [scene(folder / name / "scene.yaml", "out") for name in ("a", "b")]

    def stores(*files: Path) -> list[str]:
        configs = [scene.config for scene in with_store(read_scenes(files), "s3://bucket/maps/")]
        return [config.snapshot_store or "" for config in configs if config is not None]

    both = stores(*files)
    assert both == [*stores(files[0]), *stores(files[1])] == stores(*reversed(files))[::-1]
    assert both[0] != both[1] and all(url.startswith("s3://bucket/maps/out-") for url in both)


@pytest.fixture
def config(tmp_path: Path) -> SceneConfig:
    """Settings whose output folder holds a finished run of them, at the scale that `auto` became."""
    (tmp_path / "scene.yaml").write_text("source: {path: images}\ntracker: {kind: klt, maps: all}\noutput: out\n")
    config = load_scene(tmp_path / "scene.yaml")
    (tmp_path / "out").mkdir()
    dump_scene(config.resolved(0.75), tmp_path / "out" / "config.yaml")
    (tmp_path / "out" / "metrics.json").write_text('{"frames": 9}')
    return config


def test_a_run_with_the_same_settings_is_finished(config: SceneConfig) -> None:
    assert finished_metrics(config) == {"frames": 9} == finished_metrics(config.resolved(0.75))
    assert finished_metrics(config.model_copy(update={"threads": 3, "snapshot_every": 7, "device": "cpu"})) is not None
    assert finished_metrics(config.model_copy(update={"seed": 4})) is None
    assert finished_metrics(config.resolved(0.5)) is None


def test_a_run_whose_further_maps_are_not_finished_is_not(config: SceneConfig) -> None:
    (config.output / "metrics.json").write_text('{"frames": 9, "further_maps": 2}')
    for place in (2, 3):
        assert finished_metrics(config) is None
        (config.output / f"map-{place}").mkdir()
        (config.output / f"map-{place}" / "metrics.json").write_text("{}")
    assert finished_metrics(config) is not None


@pytest.mark.parametrize("name", ["metrics.json", "config.yaml"])
@pytest.mark.parametrize("content", [None, "", "{", "[1]", "\0"])
def test_files_that_are_missing_or_damaged_are_no_finished_run(
    config: SceneConfig, name: str, content: str | None
) -> None:
    (config.output / name).unlink()
    if content is not None:
        (config.output / name).write_text(content)
    assert finished_metrics(config) is None
