"""A result carries digests of its bytes: nothing that changed is taken for what was written."""

import os
import pickle
import shutil
import subprocess
import sys
import warnings

import numpy as np
import pytest
import xarray
from hypothesis import given, strategies as st
from scene_strategies import samples

import pbdkit
from pbdkit.io.seal import BLOCK, FOOT, BrokenSealError, SealedFile, put_seal

LARGE = ["--set=body.columns=120", "--set=body.rows=120", "--set=steps=20"]


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """The file of a run in which bonds broke, of several blocks."""
    from pbdkit.cli import main

    path = tmp_path_factory.mktemp("sound") / "sound.nc"
    with pytest.raises(SystemExit):
        main(["run", "paper/d1", "-o", str(path), "--quiet", *LARGE])
    assert path.stat().st_size > 10 * BLOCK
    return path


def test_other_programs_read_the_same_values(sound):
    plain = xarray.open_dataset(sound, engine="netcdf4", decode_times=False)
    with plain, pbdkit.open(sound) as checked:
        xarray.testing.assert_identical(plain.load(), checked.load())
        for name, variable in plain.variables.items():
            assert checked[name].dtype == variable.dtype


@samples(20)
@given(data=st.data())
def test_flipped_bit_is_never_silent(sound, tmp_path_factory, data):
    """The changed byte may lie anywhere: in values, in the metadata of HDF5, in the seal."""
    content = bytearray(sound.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    changed = tmp_path_factory.mktemp("changed") / "changed.nc"
    changed.write_bytes(content)
    with pytest.raises((pbdkit.StorageError, pbdkit.PbdkitWarning), match=r"changed\.nc: "):
        read_all(changed)


def read_all(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error", pbdkit.PbdkitWarning)
        with pbdkit.open(path) as dataset:
            dataset.load()


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.999])
def test_truncated_sealed_file_is_refused(sound, kept, tmp_path):
    content = sound.read_bytes()
    short = tmp_path / "short.nc"
    short.write_bytes(content[: int(kept * len(content))])
    with pytest.raises((pbdkit.StorageError, pbdkit.PbdkitWarning), match=r"short\.nc: "):
        read_all(short)


def test_only_data_that_is_read_is_verified(sound, tmp_path):
    """Files larger than memory stay usable, and one bad block spares the others."""
    with xarray.open_dataset(sound, engine="netcdf4", decode_times=False) as plain:
        before, last = (plain["position"][n].values for n in (-2, -1))
    content = bytearray(sound.read_bytes())
    row = np.linalg.norm(last - before, axis=1).argmax()
    assert content.count(last[row].tobytes()) == 1
    content[content.find(last[row].tobytes())] ^= 1
    changed = tmp_path / "changed.nc"
    changed.write_bytes(content)
    with pbdkit.open(changed) as dataset:
        assert np.isfinite(dataset["position"][0].values).all()
        with pytest.raises(
            BrokenSealError, match=f"of {SealedFile(changed).seal.size} have changed"
        ):
            dataset["position"][-1].load()


@given(st.binary(max_size=3 * BLOCK), st.integers(0, 2 * BLOCK), st.integers(0, 3 * BLOCK))
@samples(20)
def test_sealed_file_reads_like_its_content(tmp_path_factory, content, place, length):
    path = tmp_path_factory.mktemp("any") / "any"
    path.write_bytes(content)
    with path.open("r+b", buffering=0) as file:
        put_seal(file)
    with SealedFile(path) as file:
        assert file.seal is not None
        file.seek(place)
        assert file.read(length) == content[place : place + length]
        assert file.tell() == min(place + length, max(place, len(content)))
        assert file.seek(-len(content), os.SEEK_END) == 0
        assert file.read() == content


def test_verify_prints_one_line_per_file(sound, call, tmp_path):
    good, bad, bare = (tmp_path / name for name in ("good.nc", "bad.nc", "bare.nc"))
    shutil.copy(sound, good)
    content, table = bytearray(sound.read_bytes()), SealedFile(sound).seal.table
    begin, end = (int(stop) for stop in table["stop"][1:3])
    content[begin + 5] ^= 64
    bad.write_bytes(content)
    with xarray.open_dataset(sound, engine="netcdf4", decode_times=False) as plain:
        plain.to_netcdf(bare)
    assert call("verify", str(good)).code == 0
    result = call("verify", *map(str, (good, bad, bare, tmp_path / "missing.nc")))
    assert result.code == 6
    assert result.out.splitlines() == [
        f"{good}: unchanged since it was written",
        (
            f"{bad}: bytes {begin} to {end} of {table['stop'][-1]} have changed since they were "
            "written"
        ),
        f"{bare}: has no seal: changes since it was written cannot be detected",
        f"{tmp_path / 'missing.nc'}: there is no such file",
    ]


def test_a_damaged_seal_is_named(sound, call, tmp_path):
    content = bytearray(sound.read_bytes())
    content[-FOOT.size - 3] ^= 1
    changed = tmp_path / "changed.nc"
    changed.write_bytes(content)
    result = call("plot", str(changed))
    assert (result.code, result.err) == (
        6,
        f"pbdkit: {changed}: its seal has changed since it was written\n",
    )


def test_file_rewritten_by_another_program_gives_a_warning(sound, tmp_path):
    with xarray.open_dataset(sound, engine="netcdf4", decode_times=False) as plain:
        plain.isel(time=[0]).to_netcdf(tmp_path / "first.nc")
    with pytest.warns(pbdkit.PbdkitWarning, match=r"first\.nc: has no seal"):
        assert pbdkit.open(tmp_path / "first.nc").sizes["time"] == 1


def test_process_with_open_file_exits_cleanly(sound):
    code = "import sys, pbdkit; kept = pbdkit.open(sys.argv[1]); kept.position[0].load()"
    done = subprocess.run([sys.executable, "-c", code, str(sound)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_dataset_can_be_passed_to_another_process(sound):
    with pbdkit.open(sound) as dataset:
        copy = pickle.loads(pickle.dumps(dataset))
        np.testing.assert_array_equal(copy["position"][-1], dataset["position"][-1])
        copy.close()
