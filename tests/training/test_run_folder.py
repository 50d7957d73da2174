import json
import os

import pytest

from torchrl_mcp.training.run_folder import replacing, write_json


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


def test_json_is_written_into_folders_that_are_made(tmp_path):
    write_json({"score": 0.5}, tmp_path / "a" / "b" / "evaluation.json")
    assert json.loads((tmp_path / "a" / "b" / "evaluation.json").read_text()) == {"score": 0.5}
