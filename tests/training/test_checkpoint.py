import hashlib
import io
import json
import logging
import os
import pickle
import random
import shutil
import sys
import tempfile
import zipfile
from pathlib import Path

import pytest
import torch
from tensordict import NonTensorData, NonTensorStack
from torch import nn
from torchrl import torchrl_logger

from torchrl_mcp.modules import RunningNormaliser
from torchrl_mcp.training.checkpoint import (
    find,
    load,
    load_parts,
    rotation,
    run_checkpoint,
    save,
    saved_config,
)
from torchrl_mcp.training.run_folder import find_all

CONFIG = {"method": {"name": "mcp"}, "seed": 3}
PREFIX = "components/0000-part-gating"


def make(seed=0, *, goal_dim=2, names=("observation_normaliser", "gating", "primitives")):
    torch.manual_seed(seed)
    parts = {
        "observation_normaliser": RunningNormaliser(3),
        "gating": nn.Sequential(nn.Linear(goal_dim, 4), nn.ReLU(), nn.Linear(4, 2)),
        "primitives": nn.Linear(3, 2),
    }
    return nn.ModuleDict({name: parts[name] for name in names})


def train(parts, optimizer):
    """Take a step that changes every parameter and buffer."""
    x = torch.linspace(-1, 1, 15).view(5, 3)
    parts["observation_normaliser"].update(x)
    (parts["gating"](x[:, :2]).square().sum() + parts["primitives"](x).square().sum()).backward()
    optimizer.step()
    optimizer.zero_grad()


def components(state):
    return {name: value.clone() for name, value in state.state_dict().items()}


def same(first, second):
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


def listing(folder):
    """Every path below ``folder`` with a hash of what it holds."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run folder with one checkpoint, beside an empty folder for temporary files."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "metrics.csv").write_text("iteration\n1\n")
    rotation(folder, keep_last=2).save(run_checkpoint(make()), step=128, metadata={"config": CONFIG})
    return folder


@pytest.mark.parametrize("optimizer_class", [torch.optim.Adam, torch.optim.SGD])
def test_parts_and_optimiser_continue_to_the_same_numbers(tmp_path, optimizer_class):
    def begin(seed):
        parts = make(seed)
        settings = {"lr": 0.1} if optimizer_class is torch.optim.Adam else {"lr": 0.1, "momentum": 0.9}
        return parts, optimizer_class(parts.parameters(), **settings)

    parts, optimizer = begin(0)
    train(parts, optimizer)
    run_checkpoint(parts, optimizer=optimizer).save(tmp_path / "file")

    continued, other = begin(1)
    assert not same(components(continued), components(parts))
    load(run_checkpoint(continued, optimizer=other), tmp_path / "file")
    assert same(components(continued), components(parts))
    for pair in ((parts, optimizer), (continued, other)):
        train(*pair)
        train(*pair)
    assert same(components(continued), components(parts))


def test_what_is_restored_survives_the_file(tmp_path):
    parts = make()
    run_checkpoint(parts).save(tmp_path / "file")
    restored = make(1)
    load(run_checkpoint(restored), tmp_path / "file")
    (tmp_path / "file").write_bytes(bytes((tmp_path / "file").stat().st_size))
    assert same(components(restored), components(parts))


def test_transfer_takes_the_parts_it_keeps_and_no_others(run):
    source, target, untouched = make(), make(1), make(1)
    load_parts(target, ["primitives", "observation_normaliser"], find(run))
    assert same(components(target["primitives"]), components(source["primitives"]))
    assert same(components(target["observation_normaliser"]), components(source["observation_normaliser"]))
    assert same(components(target["gating"]), components(untouched["gating"]))


def test_restoring_is_in_place(run):
    parts = make(1)
    weight = parts["primitives"].weight
    load_parts(parts, ["primitives"], find(run))
    assert parts["primitives"].weight is weight
    assert torch.equal(weight, make()["primitives"].weight)


def test_the_newest_checkpoints_stay_and_the_newest_is_found(tmp_path):
    checkpoints = rotation(tmp_path, keep_last=2)
    for step in (100, 1000, 9000):
        saved = checkpoints.save(run_checkpoint(make(step)), step=step, metadata={"config": CONFIG})
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2
    assert find(tmp_path) == find(saved) == saved
    parts = make()
    load_parts(parts, list(parts), find(tmp_path))
    assert same(components(parts), components(make(9000)))


def test_a_copy_of_a_checkpoint_beside_the_run_s_own_is_not_taken_for_the_newest(run):
    newest = find(run)
    for name in ("checkpoint-best.torchrl", "checkpoint-.torchrl", "checkpoint-000000009999.torchrl.damaged"):
        shutil.copy(newest, newest.with_name(name))
    assert find(run) == newest


def test_a_checkpoint_is_on_the_disk_before_the_one_before_goes(tmp_path, monkeypatch):
    checkpoints, flushed, flush = rotation(tmp_path, keep_last=1), [], os.fsync

    def fsync(descriptor):
        flushed.append(sorted(path.name for path in find_all(tmp_path)))
        flush(descriptor)

    save(run_checkpoint(make()), checkpoints, step=100, config=CONFIG)
    monkeypatch.setattr(os, "fsync", fsync)
    save(run_checkpoint(make()), checkpoints, step=200, config=CONFIG)
    first, second = "checkpoint-000000000100.torchrl", "checkpoint-000000000200.torchrl"
    assert flushed == [[first], [first, second]]  # the file, and then the folder with its name
    assert [path.name for path in find_all(tmp_path)] == [second]


@pytest.mark.skipif(sys.platform != "linux", reason="limits the size of files as Linux does")
def test_where_a_tensor_finds_no_room_the_system_s_error_names_the_checkpoint_and_the_one_before_stays(tmp_path):
    import resource

    checkpoints, parts = rotation(tmp_path, keep_last=1), nn.ModuleDict({"gating": nn.Linear(400, 400)})
    save(run_checkpoint(parts), checkpoints, step=100, config=CONFIG)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        with pytest.raises(OSError, match=r"cannot write .*checkpoint-000000000200.torchrl: File too large"):
            save(run_checkpoint(parts), checkpoints, step=200, config=CONFIG)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in checkpoints.directory.iterdir()] == ["checkpoint-000000000100.torchrl"]
    load_parts(parts, ["gating"], find(tmp_path))


def test_an_archive_that_unpacks_to_more_than_its_size_is_refused_before_it_is_unpacked(run, monkeypatch):
    bomb = run / "bomb.torchrl"
    with zipfile.ZipFile(find(run)) as source, zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as target:
        for name in source.namelist():
            target.writestr(name, source.read(name))
        target.writestr("components/more.memmap", bytes(10_000_000))
    monkeypatch.setattr(zipfile.ZipFile, "open", lambda *arguments, **settings: pytest.fail("it was unpacked"))
    with pytest.raises(ValueError, match="would unpack to more than its own size"):
        load_parts(make(), ["gating"], bomb)
    with pytest.raises(ValueError, match="would unpack to more than its own size"):
        saved_config(bomb)


@pytest.mark.parametrize("place", [".", "absent", "temporary"])
def test_where_there_is_no_checkpoint_that_is_said(run, place):
    with pytest.raises(ValueError, match="neither a checkpoint file nor a run folder"):
        find(run.parent / place)


def test_a_checkpoint_tells_the_configuration_that_wrote_it(run):
    assert saved_config(find(run)) == CONFIG


def truncate(data, share):
    return data[: int(len(data) * share)]


def flip(data, where):
    position = {"header": 2, "tensor": data.index(b"tensor_00000000.memmap") + 30, "end": len(data) - 3}[where]
    return data[:position] + bytes([data[position] ^ 0x40]) + data[position + 1 :]


def archive(**members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as zipped:
        for name, content in members.items():
            zipped.writestr(name, content)
    return file.getvalue()


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(lambda data: b"", id="empty"),
        *(pytest.param(lambda data, s=s: truncate(data, s), id=f"cut to {s}") for s in (0.01, 0.5, 0.99)),
        pytest.param(lambda data: data[:-1], id="last byte lost"),
        *(pytest.param(lambda data, w=w: flip(data, w), id=f"bit flipped in {w}") for w in ("header", "tensor", "end")),
        pytest.param(
            lambda data: b"PK\x03\x04" + random.Random(0).randbytes(2000), id="noise that begins like an archive"
        ),
        pytest.param(lambda data: b"iteration,loss\n1,0.5\n", id="a text"),
        pytest.param(lambda data: archive(notes=b"hello"), id="another archive"),
        pytest.param(lambda data: archive(**{"manifest.json": b"[]"}), id="another manifest"),
        pytest.param(lambda data: archive(**{"manifest.json": b"\xff{"}), id="a manifest that is no text"),
        pytest.param(lambda data: pickle.dumps({"gating": 1}), id="a pickle"),
    ],
)
def test_a_damaged_or_foreign_file_is_refused_by_name_and_nothing_on_disk_changes(run, spoil):
    file = find(run)
    file.write_bytes(spoil(file.read_bytes()))
    before, parts = listing(run.parent), make(1)
    with pytest.raises(ValueError, match="checkpoint of the same configuration") as failure:
        load_parts(parts, list(parts), file)
    assert str(file) in str(failure.value)
    assert listing(run.parent) == before
    assert same(components(parts), components(make(1)))


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        pytest.param(make(goal_dim=5), "size mismatch", id="other sizes"),
        pytest.param(nn.ModuleDict({"policy": nn.Linear(3, 2)}), "part-policy", id="a part it lacks"),
        pytest.param(nn.ModuleDict({"gating": nn.Linear(3, 2)}), "Missing key", id="another architecture"),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_refused_and_nothing_on_disk_changes(run, parts, expected):
    before = listing(run.parent)
    with pytest.raises(ValueError, match=expected) as failure:
        load_parts(parts, list(parts), find(run))
    assert "method, character, task or network size" in str(failure.value)
    assert listing(run.parent) == before


def test_a_missing_component_of_a_run_is_named(run):
    parts = make()
    with pytest.raises(ValueError, match="progress"):
        load(run_checkpoint(parts, progress=torch.optim.SGD(parts.parameters())), find(run))


def test_a_missing_file_is_refused_and_not_created(run):
    before = listing(run.parent)
    with pytest.raises(ValueError, match="there is no checkpoint file"):
        load_parts(make(), ["gating"], run / "checkpoints" / "absent")
    with pytest.raises(ValueError, match="there is no checkpoint file"):
        load_parts(make(), ["gating"], run)
    assert listing(run.parent) == before


@pytest.mark.parametrize("content", [b"", b"text", archive(notes=b"hello"), archive(**{"manifest.json": b"[]"})])
def test_what_is_no_checkpoint_tells_no_configuration(tmp_path, content):
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(ValueError, match=r"is not a checkpoint of torchrl-mcp"):
        saved_config(tmp_path / "file")
    with pytest.raises(ValueError, match=r"is not a checkpoint of torchrl-mcp"):
        saved_config(tmp_path / "absent")


def test_a_flipped_bit_anywhere_is_refused_or_without_effect(run):
    """The archive has bits that mean nothing here, time stamps for example; none may change a number unnoticed."""
    file = find(run)
    data, parts, generator = file.read_bytes(), make(1), random.Random(0)
    refused = 0
    for position in range(0, len(data), 41):
        spoilt = bytearray(data)
        spoilt[position] ^= 1 << generator.randrange(8)
        file.write_bytes(spoilt)
        try:
            load_parts(parts, list(parts), file)
        except ValueError:
            refused += 1
        else:
            assert same(components(parts), components(make())), position
    assert refused > 50


@pytest.fixture
def without_pickle(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("something was unpickled")

    for name in ("load", "loads", "Unpickler", "_Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    monkeypatch.setattr(torch, "load", refuse)
    monkeypatch.setattr(torch.serialization, "load", refuse)


def test_saving_and_loading_never_unpickles(run, without_pickle):
    parts = make(1)
    optimizer = torch.optim.Adam(parts.parameters())
    train(parts, optimizer)
    run_checkpoint(parts, optimizer=optimizer).save(run / "file", metadata={"config": CONFIG})
    restored = make(2)
    load(run_checkpoint(restored, optimizer=torch.optim.Adam(restored.parameters())), run / "file")
    assert same(components(restored), components(parts))
    assert saved_config(run / "file") == CONFIG


class Malice:
    """Creates a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


STATE = f"{PREFIX}/state"
SMUGGLED = {
    "a field of a tensordict": {
        f"{STATE}/evil/meta.json": {"_type": str(NonTensorData)},
        f"{STATE}/evil/other.pickle": None,
    },
    "a stack of fields": {
        f"{STATE}/evil/meta.json": {"_type": str(NonTensorStack), "data": "pickle.pkl", "device": None},
        f"{STATE}/evil/pickle.pkl": None,
    },
    "a torch file": {f"{PREFIX}/state.pt": None},
}


@pytest.mark.parametrize("members", SMUGGLED.values(), ids=SMUGGLED)
def test_a_pickle_smuggled_into_an_archive_is_not_executed(run, members):
    file, marker = find(run), run / "executed"
    with zipfile.ZipFile(file) as source:
        contents = {name: source.read(name) for name in source.namelist()}
    manifest, meta = json.loads(contents["manifest.json"]), json.loads(contents[f"{STATE}/meta.json"])
    manifest["components"]["part-gating"]["files"] += [name.removeprefix(f"{PREFIX}/") for name in members]
    meta["evil"] = {"type": "NonTensorData"}
    contents |= {"manifest.json": json.dumps(manifest), f"{STATE}/meta.json": json.dumps(meta)}
    for name, content in members.items():
        contents[name] = pickle.dumps(Malice(marker)) if content is None else json.dumps(content)
    file.write_bytes(archive(**contents))

    parts = make(1)
    with pytest.raises(ValueError, match="neither JSON nor a tensor"):
        load_parts(parts, list(parts), file)
    assert not marker.exists()
    assert same(components(parts), components(make(1)))


@pytest.mark.parametrize(("version", "warned"), [("{}+cu999", False), ("1.2.{}", True)], ids=["build", "version"])
def test_only_another_version_of_torch_is_warned_of_and_not_another_build(run, version, warned):
    path, messages = find(run), []
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
        load_parts(make(1), ["gating"], path)
    finally:
        torchrl_logger.removeHandler(handler)
    assert any("version skew" in message for message in messages) == warned
