import json
import logging
import os
import pickle
import shutil
import sys
import zipfile

import pytest
import torch
from refusals import refused
from torch import nn
from torchrl import torchrl_logger

from torchrl_mcp.training.checkpoint import (
    RunRandomness,
    find,
    is_intact,
    load,
    load_parts,
    rotation,
    run_checkpoint,
    save,
    saved_config,
)
from torchrl_mcp.training.run_folder import find_all


def train(parts, optimizer):
    """Take a step that changes every parameter and buffer."""
    x = torch.linspace(-1, 1, 15).view(5, 3)
    parts["observation_normaliser"].update(x)
    (parts["gating"](x[:, :2]).square().sum() + parts["primitives"](x).square().sum()).backward()
    optimizer.step()
    optimizer.zero_grad()


@pytest.mark.parametrize("optimizer_class", [torch.optim.Adam, torch.optim.SGD])
def test_parts_and_optimiser_continue_to_the_same_numbers(tmp_path, optimizer_class, make_parts, same_numbers):
    def begin(seed):
        parts = make_parts(seed)
        settings = {"lr": 0.1} if optimizer_class is torch.optim.Adam else {"lr": 0.1, "momentum": 0.9}
        return parts, optimizer_class(parts.parameters(), **settings)

    parts, optimizer = begin(0)
    train(parts, optimizer)
    run_checkpoint(parts, optimizer=optimizer).save(tmp_path / "file")

    continued, other = begin(1)
    assert not same_numbers(continued, parts)
    load(run_checkpoint(continued, optimizer=other), tmp_path / "file")
    assert same_numbers(continued, parts)
    for pair in ((parts, optimizer), (continued, other)):
        train(*pair)
        train(*pair)
    assert same_numbers(continued, parts)


def test_what_is_restored_survives_the_file(tmp_path, make_parts, same_numbers):
    parts = make_parts()
    run_checkpoint(parts).save(tmp_path / "file")
    restored = make_parts(1)
    load(run_checkpoint(restored), tmp_path / "file")
    (tmp_path / "file").write_bytes(bytes((tmp_path / "file").stat().st_size))
    assert same_numbers(restored, parts)


def test_transfer_takes_the_parts_it_keeps_and_no_others(saved_run, make_parts, same_numbers):
    source, target, untouched = make_parts(), make_parts(1), make_parts(1)
    load_parts(target, ["primitives", "observation_normaliser"], find(saved_run))
    assert same_numbers(target["primitives"], source["primitives"])
    assert same_numbers(target["observation_normaliser"], source["observation_normaliser"])
    assert same_numbers(target["gating"], untouched["gating"])


def test_restoring_is_in_place(saved_run, make_parts):
    parts = make_parts(1)
    weight = parts["primitives"].weight
    load_parts(parts, ["primitives"], find(saved_run))
    assert parts["primitives"].weight is weight
    assert torch.equal(weight, make_parts()["primitives"].weight)


def test_the_newest_checkpoints_stay_and_the_newest_is_found(tmp_path, make_parts, same_numbers, config):
    checkpoints = rotation(tmp_path, keep_last=2)
    for step in (100, 1000, 9000):
        saved = checkpoints.save(run_checkpoint(make_parts(step)), step=step, metadata={"config": config})
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2
    assert find(tmp_path) == find(saved) == saved
    parts = make_parts()
    load_parts(parts, list(parts), find(tmp_path))
    assert same_numbers(parts, make_parts(9000))


def test_a_copy_of_a_checkpoint_beside_the_run_s_own_is_not_taken_for_the_newest(saved_run):
    newest = find(saved_run)
    for name in ("checkpoint-best.torchrl", "checkpoint-.torchrl", "checkpoint-000000009999.torchrl.damaged"):
        shutil.copy(newest, newest.with_name(name))
    assert find(saved_run) == newest


def test_a_checkpoint_is_on_the_disk_before_the_one_before_goes(tmp_path, monkeypatch, make_parts, config):
    checkpoints, flushed, flush = rotation(tmp_path, keep_last=1), [], os.fsync

    def fsync(descriptor):
        flushed.append(sorted(path.name for path in find_all(tmp_path)))
        flush(descriptor)

    save(run_checkpoint(make_parts()), checkpoints, step=100, config=config)
    monkeypatch.setattr(os, "fsync", fsync)
    save(run_checkpoint(make_parts()), checkpoints, step=200, config=config)
    first, second = "checkpoint-000000000100.torchrl", "checkpoint-000000000200.torchrl"
    assert flushed == [[first], [first, second]]  # the file, and then the folder with its name
    assert [path.name for path in find_all(tmp_path)] == [second]


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files as Linux does")
def test_where_a_tensor_finds_no_room_the_system_s_error_names_the_checkpoint_and_the_one_before_stays(
    tmp_path, config
):
    import resource

    checkpoints, parts = rotation(tmp_path, keep_last=1), nn.ModuleDict({"gating": nn.Linear(400, 400)})
    save(run_checkpoint(parts), checkpoints, step=100, config=config)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        with pytest.raises(OSError, match=r"checkpoint-000000000200\.torchrl"):
            save(run_checkpoint(parts), checkpoints, step=200, config=config)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in checkpoints.directory.iterdir()] == ["checkpoint-000000000100.torchrl"]
    load_parts(parts, ["gating"], find(tmp_path))


@pytest.mark.skipif(sys.platform != "linux", reason="limits open files as Linux does")
def test_where_the_system_has_no_more_files_an_intact_checkpoint_is_not_called_damaged(saved_run):
    import resource

    path, limits = find(saved_run), resource.getrlimit(resource.RLIMIT_NOFILE)
    lowest = os.dup(0)
    os.close(lowest)
    for ask in (
        is_intact,
        saved_config,
        lambda path: load_parts(nn.ModuleDict({"gating": nn.Linear(1, 1)}), ["gating"], path),
    ):
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, limits[1]))
            with pytest.raises(OSError, match="open files"):
                ask(path)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    assert is_intact(path)


@pytest.mark.parametrize("place", [".", "absent", "temporary"])
def test_where_there_is_no_checkpoint_that_is_said(saved_run, place):
    refused(lambda: find(saved_run.parent / place), str(saved_run.parent / place))


def test_a_checkpoint_tells_the_configuration_that_wrote_it(saved_run, config):
    assert saved_config(find(saved_run)) == config


@pytest.fixture
def without_pickle(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("something was unpickled")

    for name in ("load", "loads", "Unpickler", "_Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    monkeypatch.setattr(torch, "load", refuse)
    monkeypatch.setattr(torch.serialization, "load", refuse)


def test_saving_and_loading_never_unpickles(saved_run, without_pickle, make_parts, same_numbers, config):
    parts = make_parts(1)
    optimizer = torch.optim.Adam(parts.parameters())
    train(parts, optimizer)
    run_checkpoint(parts, optimizer=optimizer).save(saved_run / "file", metadata={"config": config})
    restored = make_parts(2)
    load(run_checkpoint(restored, optimizer=torch.optim.Adam(restored.parameters())), saved_run / "file")
    assert same_numbers(restored, parts)
    assert saved_config(saved_run / "file") == config


@pytest.mark.parametrize(("version", "warned"), [("{}+cu999", False), ("1.2.{}", True)], ids=["build", "version"])
def test_only_another_version_of_torch_is_warned_of_and_not_another_build(saved_run, version, warned, make_parts):
    path, messages = find(saved_run), []
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    manifest = json.loads(members["manifest.json"])
    manifest["versions"]["torch"] = version.format(torch.__version__.split("+")[0])
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (members | {"manifest.json": json.dumps(manifest).encode()}).items():
            archive.writestr(name, content)
    handler = logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())
    torchrl_logger.addHandler(handler)
    try:
        load_parts(make_parts(1), ["gating"], path)
    finally:
        torchrl_logger.removeHandler(handler)
    assert all("another version of torch" in message for message in messages)
    assert len(messages) == warned


def test_random_states_of_a_run_on_gpus_are_restored_without_them():
    here = RunRandomness(torch.device("cpu"))
    elsewhere = here.state_dict() | {"torch_cuda": [torch.get_rng_state()] * 8, "cuda": torch.get_rng_state()}
    expected = torch.rand(3)
    here.load_state_dict(elsewhere)
    assert torch.equal(torch.rand(3), expected)
    assert not {"cuda", "torch_cuda"} & set(here.state_dict())


def test_the_random_state_of_the_own_gpu_is_saved_and_restored_alone(monkeypatch):
    states = {torch.device("cuda", index): torch.full((2,), index) for index in range(4)}
    monkeypatch.setattr(torch.cuda, "get_rng_state", lambda device: states[device].clone())
    monkeypatch.setattr(torch.cuda, "set_rng_state", lambda state, device: states.update({device: state}))
    saved = RunRandomness(torch.device("cuda", 3)).state_dict()
    RunRandomness(torch.device("cuda", 0)).load_state_dict(saved)
    assert [state[0].item() for state in states.values()] == [3, 1, 2, 3]
