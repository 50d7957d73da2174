import io
import json
import pickle
import random
import zipfile
from functools import partial
from pathlib import Path

import pytest
import torch
from refusals import refused
from tensordict import NonTensorData, NonTensorStack
from torch import nn

from torchrl_mcp.training.checkpoint import (
    find,
    is_intact,
    load,
    load_parts,
    run_checkpoint,
    saved_config,
)

PREFIX = "components/0000-part-gating"


def test_an_archive_that_unpacks_to_more_than_its_size_is_refused_before_it_is_unpacked(
    saved_run, monkeypatch, make_parts
):
    bomb = saved_run / "bomb.torchrl"
    with zipfile.ZipFile(find(saved_run)) as source, zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as target:
        for name in source.namelist():
            target.writestr(name, source.read(name))
        target.writestr("components/more.memmap", bytes(10_000_000))
    monkeypatch.setattr(zipfile.ZipFile, "open", lambda *arguments, **settings: pytest.fail("it was unpacked"))
    refused(lambda: load_parts(make_parts(), ["gating"], bomb), str(bomb))
    refused(lambda: saved_config(bomb), str(bomb))


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


def test_a_checkpoint_with_a_flipped_bit_in_a_tensor_is_not_intact(saved_run):
    path = find(saved_run)
    assert is_intact(path)
    path.write_bytes(flip(path.read_bytes(), "tensor"))
    assert not is_intact(path)


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
def test_a_damaged_or_foreign_file_is_refused_by_name_and_nothing_on_disk_changes(
    saved_run, spoil, make_parts, same_numbers
):
    file = find(saved_run)
    file.write_bytes(spoil(file.read_bytes()))
    parts = make_parts(1)
    refused(lambda: load_parts(parts, list(parts), file), str(file), untouched=saved_run.parent)
    assert same_numbers(parts, make_parts(1))


@pytest.mark.parametrize(
    "make",
    [
        lambda make_parts: make_parts(goal_dim=5),
        lambda make_parts: nn.ModuleDict({"policy": nn.Linear(3, 2)}),
        lambda make_parts: nn.ModuleDict({"gating": nn.Linear(3, 2)}),
    ],
    ids=["other sizes", "a part it lacks", "another architecture"],
)
def test_a_checkpoint_that_does_not_fit_is_refused_and_nothing_on_disk_changes(saved_run, make, make_parts):
    parts, file = make(make_parts), find(saved_run)
    refused(lambda: load_parts(parts, list(parts), file), str(file), untouched=saved_run.parent)


def test_a_missing_component_of_a_run_is_named(saved_run, make_parts):
    parts = make_parts()
    run = run_checkpoint(parts, progress=torch.optim.SGD(parts.parameters()))
    refused(lambda: load(run, find(saved_run)), "progress")


def test_a_missing_file_is_refused_and_not_created(saved_run, make_parts):
    for file in (saved_run / "checkpoints" / "absent", saved_run):
        load_it = partial(load_parts, make_parts(), ["gating"], file)
        refused(load_it, str(file), untouched=saved_run.parent)


@pytest.mark.parametrize("content", [b"", b"text", archive(notes=b"hello"), archive(**{"manifest.json": b"[]"})])
def test_what_is_no_checkpoint_tells_no_configuration(tmp_path, content):
    (tmp_path / "file").write_bytes(content)
    for file in (tmp_path / "file", tmp_path / "absent"):
        refused(partial(saved_config, file), str(file))


def test_a_flipped_bit_anywhere_is_refused_or_without_effect(saved_run, make_parts, same_numbers):
    """The archive has bits that mean nothing here, time stamps for example; none may change a number unnoticed."""
    file = find(saved_run)
    data, parts, generator = file.read_bytes(), make_parts(1), random.Random(0)
    refusals = 0
    for position in range(0, len(data), 41):
        spoilt = bytearray(data)
        spoilt[position] ^= 1 << generator.randrange(8)
        file.write_bytes(spoilt)
        try:
            load_parts(parts, list(parts), file)
        except ValueError:
            refusals += 1
        else:
            assert same_numbers(parts, make_parts()), position
    assert refusals > 50


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
def test_a_pickle_smuggled_into_an_archive_is_not_executed(saved_run, members, make_parts, same_numbers):
    file, marker = find(saved_run), saved_run / "executed"
    with zipfile.ZipFile(file) as source:
        contents = {name: source.read(name) for name in source.namelist()}
    manifest, meta = json.loads(contents["manifest.json"]), json.loads(contents[f"{STATE}/meta.json"])
    manifest["components"]["part-gating"]["files"] += [name.removeprefix(f"{PREFIX}/") for name in members]
    meta["evil"] = {"type": "NonTensorData"}
    contents |= {"manifest.json": json.dumps(manifest), f"{STATE}/meta.json": json.dumps(meta)}
    for name, content in members.items():
        contents[name] = pickle.dumps(Malice(marker)) if content is None else json.dumps(content)
    file.write_bytes(archive(**contents))

    parts = make_parts(1)
    refused(lambda: load_parts(parts, list(parts), file), str(file))
    assert not marker.exists()
    assert same_numbers(parts, make_parts(1))
