"""The scenes of a batch: read one by one, each with an output folder and a storage of its own."""

from __future__ import annotations

from pathlib import Path

import pytest

from modp_ti.many.batch import with_resources
from modp_ti.many.pool import Resources
from modp_ti.many.scenes import SNAPSHOT_EVERY, read_scenes, with_store

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
    scene(folder / "good.yaml", "maps/good")
    scene(folder / "bad.yaml", "maps/bad", "nonsense: 1\n")
    scene(folder / "live.yaml", "maps/live").write_text("source: {stream: 0}\ntracker: {kind: klt}\noutput: live\n")
    scenes = read_scenes([folder / name for name in ("good.yaml", "gone.yaml", "bad.yaml", "live.yaml")])
    assert [scene.name for scene in scenes] == ["good", "gone.yaml", "bad.yaml", "live.yaml"]
    assert [scene.config is not None for scene in scenes] == [True, False, False, False]
    assert ["" if scene.error == "" else scene.error.split(": ", 1)[1] for scene in scenes[:2]] == [
        "",
        "no such scene file",
    ]
    assert "unknown key `nonsense`" in scenes[2].error
    assert "a live source has no place in a batch" in scenes[3].error


def test_no_two_scenes_write_to_one_folder(folder: Path) -> None:
    first, second = scene(folder / "a.yaml", "maps/x"), scene(folder / "b.yaml", "maps/x")
    scenes = read_scenes([first, second, first, folder / "." / "a.yaml"])
    assert [scene.given for scene in scenes] == [first, second], "one that is named twice counts once"
    assert "is the output folder of" in scenes[1].error and str(first) in scenes[1].error


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


def test_names_are_unique_where_output_folders_have_the_same_name(folder: Path) -> None:
    files = [scene(folder / name / "scene.yaml", "out") for name in ("a", "b", "c")]
    assert [scene.name for scene in read_scenes(files)] == ["out", "out-2", "out-3"]


def test_scenes_are_saved_on_the_way_where_they_can_be_resumed(folder: Path) -> None:
    files = [
        scene(folder / "a.yaml", "a"),
        scene(folder / "b.yaml", "b", "snapshot_every: 7\n"),
        scene(folder / "c.yaml", "c", "mode: offline\n"),
        scene(folder / "d.yaml", "d", "snapshot_every: 0\n"),
        scene(folder / "e.yaml", "e", "view: true\n"),
    ]
    configs = [scene.config for scene in read_scenes(files)]
    assert [config and config.snapshot_every for config in configs] == [SNAPSHOT_EVERY, 7, None, 0, SNAPSHOT_EVERY]
    assert not any(config and config.view.enabled for config in configs)


def test_a_process_has_the_threads_and_the_device_that_were_asked_for(folder: Path) -> None:
    (plain, own) = read_scenes([scene(folder / "a.yaml", "a"), scene(folder / "b.yaml", "b", "threads: 2\n")])
    assert plain.config is not None and own.config is not None
    for config, resources, expected in (
        (plain.config, Resources(3.0), (3, "cpu")),
        (plain.config, Resources(0.5, 0.5), (1, "auto")),
        (own.config, Resources(3.0, 1.0), (2, "auto")),
    ):
        given = with_resources(config, resources)
        assert (given.threads, given.device) == expected


def test_the_storage_of_a_scene_does_not_depend_on_the_others(folder: Path) -> None:
    files = [scene(folder / name / "scene.yaml", "out") for name in ("a", "b")]

    def stores(*files: Path) -> list[str]:
        configs = [scene.config for scene in with_store(read_scenes(files), "s3://bucket/maps/")]
        return [config.snapshot_store or "" for config in configs if config is not None]

    both = stores(*files)
    assert both == [*stores(files[0]), *stores(files[1])] == stores(*reversed(files))[::-1]
    assert both[0] != both[1] and all(url.startswith("s3://bucket/maps/out-") for url in both)
