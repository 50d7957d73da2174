import json
import os
import sys
import tempfile

import pytest
from refusals import refused

from torchrl_mcp.training.run_folder import read_json, remove_leftovers, replacing, write_json


def test_readers_find_the_old_content_until_the_new_is_whole(tmp_path):
    file = tmp_path / "numbers.csv"
    file.write_text("old")
    with replacing(file) as partial:
        partial.write_text("ne")
        assert file.read_text() == "old"
        partial.write_text("new")
    assert file.read_text() == "new"
    assert [path.name for path in tmp_path.iterdir()] == ["numbers.csv"]


def test_a_block_that_fails_leaves_the_old_file_and_nothing_else(tmp_path):
    file = tmp_path / "numbers.csv"
    file.write_text("old")

    def interrupted():
        with replacing(file) as partial:
            partial.write_text("ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert file.read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["numbers.csv"]


def test_the_content_is_on_the_disk_before_it_gets_its_name_and_then_the_name_is(tmp_path, monkeypatch):
    file, flushed, flush = tmp_path / "numbers.csv", [], os.fsync

    def fsync(descriptor):
        flushed.append((os.fstat(descriptor).st_ino, file.exists()))
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    with replacing(file) as partial:
        partial.write_text("new")
    assert flushed == [(file.stat().st_ino, False), (tmp_path.stat().st_ino, True)]


def test_where_folders_cannot_be_flushed_files_still_are(tmp_path, monkeypatch):
    flushed, flush = [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda descriptor: flushed.append(descriptor) or flush(descriptor))
    monkeypatch.setattr(sys, "platform", "win32")
    with replacing(tmp_path / "numbers.csv") as partial:
        partial.write_text("new")
    assert len(flushed) == 1
    assert (tmp_path / "numbers.csv").read_text() == "new"


@pytest.mark.parametrize("content", [b"{", b"[1]", b"\xe9", b"[" * 100_000])
def test_a_damaged_file_is_named_with_the_remedy(tmp_path, content):
    path = tmp_path / "origin.json"
    path.write_bytes(content)
    refused(lambda: read_json(path), str(path), "copy")


def test_json_is_written_into_folders_that_are_made(tmp_path):
    write_json({"score": 0.5}, tmp_path / "a" / "b" / "evaluation.json")
    assert json.loads((tmp_path / "a" / "b" / "evaluation.json").read_text()) == {"score": 0.5}


def test_what_killed_processes_left_is_removed_and_nothing_else(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    run, temporary = tmp_path / "run", tmp_path / "temporary"
    kept = [run / "config.yaml", run / "checkpoints/checkpoint-000000000128.torchrl", temporary / "other/file"]
    kept.append(temporary / "torchrl-checkpoint-load-young/manifest.json")
    kept += [run / "data/recording.bag.partial", run / "checkpoints/.git/config", run / "checkpoints/.gitignore"]
    kept.append(run / "another_run/checkpoints/checkpoint-000000000256.torchrl.partial")
    left = [
        run / "checkpoints/.checkpoint-000000000256.torchrl.partial.stage-1f/components/0/x.memmap",
        run / "checkpoints/.checkpoint-000000000256.torchrl.partial.archive-2e",
        run / "checkpoints/checkpoint-000000000256.torchrl.partial",
        run / "evaluation.json.partial",
        run / "csv/scalars/reward.csv.partial",
        temporary / "torchrl-checkpoint-load-old/components/x.memmap",
    ]
    for path in (*kept, *left):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("content")
    os.utime(temporary / "torchrl-checkpoint-load-old", (0, 0))
    remove_leftovers(run)
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == set(kept)
    assert not (temporary / "torchrl-checkpoint-load-old").exists()
