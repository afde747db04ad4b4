"""Checkpoint files: whole or not at all, damage is noticed, no code is run."""

import errno
import os
import pickle
import random
import stat
import zipfile

import numpy as np
import pytest
import torch

from mappo_unity.runs import checkpoint
from mappo_unity.runs.checkpoint import CheckpointError, load, newest_good, save, save_in, to_arrays

STATE = {
    "weights": {"a": torch.arange(1000.0)},
    "count": 3,
    "rng": np.arange(5, dtype=np.uint64),
    "none": None,
}


def test_what_is_saved_comes_back(tmp_path):
    save(
        tmp_path / "x.pt",
        STATE | {"big": 2**127 + 1, "array": np.eye(2), "one": np.zeros(()), "flag": np.bool_(True)},
    )
    state = to_arrays(load(tmp_path / "x.pt"))
    assert np.array_equal(state["weights"]["a"], np.arange(1000.0))
    assert state["rng"].dtype == np.uint64 and state["rng"].tolist() == [0, 1, 2, 3, 4]
    assert state["one"].shape == ()
    assert state["big"] == 2**127 + 1 and state["none"] is None and state["flag"] is True


def test_rotation_keeps_the_newest_and_the_best(tmp_path):
    for steps in range(1, 8):
        save_in(tmp_path, steps * 100, STATE, keep=3, best=steps == 2)
    names = sorted(p.name for p in (tmp_path / "checkpoints").iterdir())
    assert names == ["best.pt", "step_000000000500.pt", "step_000000000600.pt", "step_000000000700.pt"]
    assert load(tmp_path / "checkpoints" / "best.pt")["count"] == 3


def test_every_flipped_byte_is_noticed_or_harmless(tmp_path):
    path = save_in(tmp_path, 100, STATE, keep=3, best=False)
    good = path.read_bytes()
    generator = random.Random(0)
    noticed = 0
    for _ in range(150):
        position = generator.randrange(len(good))
        bad = bytearray(good)
        bad[position] ^= 1 << generator.randrange(8)
        path.write_bytes(bytes(bad))
        try:
            state = load(path)
        except CheckpointError as error:
            assert str(path) in str(error)
            noticed += 1
        else:
            assert torch.equal(state["weights"]["a"], STATE["weights"]["a"]) and state["count"] == 3
    assert noticed > 100


def test_truncated_files_fall_back_to_the_newest_good_one_and_say_so(tmp_path):
    for steps in (100, 200, 300):
        save_in(tmp_path, steps, STATE, keep=5, best=False)
    newest = tmp_path / "checkpoints" / "step_000000000300.pt"
    newest.write_bytes(newest.read_bytes()[:-700])
    path, warnings = newest_good(tmp_path)
    assert path.name == "step_000000000200.pt"
    assert len(warnings) == 1 and "step_000000000300.pt" in warnings[0]
    path, warnings = newest_good(newest)
    assert path.name == "step_000000000200.pt" and len(warnings) == 1
    for file in (tmp_path / "checkpoints").iterdir():
        file.write_bytes(b"")
    with pytest.raises(CheckpointError, match="no good checkpoint"):
        newest_good(tmp_path)


def test_missing_folders_and_folders_without_checkpoints(tmp_path):
    with pytest.raises(CheckpointError, match="does not exist"):
        newest_good(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match="holds no checkpoint"):
        newest_good(tmp_path)


def test_a_removed_run_folder_is_not_made_again(tmp_path):
    with pytest.raises(CheckpointError, match="run was removed or moved"):
        save_in(tmp_path / "run", 100, STATE, keep=5, best=True)
    assert not (tmp_path / "run").exists()


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("boom",)


@pytest.mark.parametrize("kind", ["pickle", "torch"])
def test_a_pickle_that_would_run_code_is_refused(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "step_000000000100.pt"
    if kind == "pickle":
        path.write_bytes(pickle.dumps({"format": 2, "x": Bomb()}))
    else:
        torch.save({"format": 2, "x": Bomb()}, path)
        assert zipfile.is_zipfile(path)
    with pytest.raises(CheckpointError, match="damaged or no checkpoint"):
        load(path)
    assert not (tmp_path / "boom").exists()


def test_other_formats_are_refused(tmp_path):
    torch.save({"format": 99}, tmp_path / "a.pt")
    with pytest.raises(CheckpointError, match="has format 99, but this version reads format 2"):
        load(tmp_path / "a.pt")


def test_a_file_system_that_does_not_sync_folders_is_no_hindrance(tmp_path, monkeypatch):
    fsync = os.fsync

    def of_files_alone(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        fsync(descriptor)

    monkeypatch.setattr(checkpoint.os, "fsync", of_files_alone)
    save_in(tmp_path, 100, STATE, keep=3, best=True)
    assert newest_good(tmp_path)[0].name == "step_000000000100.pt"


@pytest.mark.parametrize("call", ["save", "fsync"])
def test_a_full_disk_leaves_the_previous_checkpoint(tmp_path, monkeypatch, call):
    save_in(tmp_path, 100, STATE, keep=3, best=True)

    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(checkpoint.torch if call == "save" else checkpoint.os, call, full)
    with pytest.raises(CheckpointError, match="No space left on device.*resume="):
        save_in(tmp_path, 200, STATE, keep=3, best=True)
    monkeypatch.undo()
    names = sorted(p.name for p in (tmp_path / "checkpoints").iterdir())
    assert names == ["best.pt", "step_000000000100.pt"]
    assert newest_good(tmp_path)[0].name == "step_000000000100.pt"


@pytest.fixture
def unremovable(monkeypatch):
    def unlink(path, missing_ok=False):
        if path.exists():
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr(checkpoint.Path, "unlink", unlink)


def test_an_old_checkpoint_that_cannot_be_removed_ends_no_run(tmp_path, unremovable):
    for steps in (100, 200, 300):
        save_in(tmp_path, steps, STATE, keep=1, best=True)
    names = [path.name for path in checkpoint.checkpoints_in(tmp_path)]
    assert names == [f"step_{steps:012d}.pt" for steps in (100, 200, 300)]


def test_a_best_checkpoint_that_cannot_be_made_is_told(tmp_path, monkeypatch):
    save_in(tmp_path, 100, STATE, keep=1, best=True)
    replace = os.replace

    def refuse(source, target):
        if os.path.basename(target) == "best.pt":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(target))
        replace(source, target)

    monkeypatch.setattr(checkpoint.os, "replace", refuse)
    with pytest.raises(CheckpointError, match="step_0+200.pt was written, but best.pt could not be made"):
        save_in(tmp_path, 200, STATE, keep=1, best=True)
    assert newest_good(tmp_path)[0].name == "step_000000000200.pt"
