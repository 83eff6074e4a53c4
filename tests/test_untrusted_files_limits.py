"""Files of strangers: what they declare is bounded, nothing outside them is read without a word,
and whatever is wrong is a message that names the file."""

from __future__ import annotations

import json
import os
import time
from io import FileIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray
from reliability import hostile_files

import pbdkit
from pbdkit.io.seal import put_seal, seal_of
from pbdkit.model import validation as field_file
from pbdkit.model.reading import ALLOW_OUTSIDE, OF_PROGRAM
from pbdkit.model.validation import read_field
from pbdkit.untrusted_files import check_declared

STEPS = "step,ux,uy\n1,0.1,0.0\n"
FIELD = {"file": "f.nc", "variable": "E"}


def write_field(path: Path, **attributes: Any) -> None:
    x = np.arange(4.0) * 3 - 1
    values = np.arange(1.0, 17.0).reshape(4, 4)
    xarray.Dataset({"E": (("x", "y"), values)}, {"x": x, "y": x}).to_netcdf(path, engine="h5netcdf")
    with h5py.File(path, "r+") as file:
        file["E"].attrs.update(attributes)


def with_field(tensile: dict[str, Any], file: str = "f.nc") -> dict[str, Any]:
    field = {"file": file, "variable": "E"}
    return tensile | {
        "neighbours": {"type": "chebyshev", "shells": 1},
        "rule": {"type": "elastic", "poisson_ratio": 0.3, "stiffness": field},
    }


def with_table(tensile: dict[str, Any], file: str) -> dict[str, Any]:
    leaders = json.loads(json.dumps(tensile["leaders"]))
    leaders[1]["motion"] = {"type": "table", "file": file}
    return tensile | {"leaders": leaders}


def bomb(file: h5py.File) -> None:
    file.create_dataset("z", (1_500_000_000,), "f8", chunks=(1_000_000,)).make_scale("z")


def external(file: h5py.File) -> None:
    Path("other.bin").write_bytes(bytes(80))
    file.create_dataset("more", (10,), "f8", external=[("other.bin", 0, 80)])


def link(file: h5py.File) -> None:
    file["more"] = h5py.ExternalLink("other.h5", "/E")


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((4,), "f8")
    layout[...] = h5py.VirtualSource("other.h5", "E", (4,))
    file.create_virtual_dataset("more", layout)


def circle(file: h5py.File) -> None:
    file.create_group("more")["again"] = file["/"]


def lzf(file: h5py.File) -> None:
    file.create_dataset("more", data=np.ones(6), compression="lzf")


def large_chunk(file: h5py.File) -> None:
    file.create_dataset("more", (5,), "f8", chunks=(2**28,), maxshape=(None,), compression="gzip")


def one_text_for_many(file: h5py.File) -> None:
    file.attrs.create("more", [b"x"] * 50_000, dtype=h5py.string_dtype())


def no_texts(file: h5py.File) -> None:
    file.create_dataset("more", (3,), h5py.vlen_dtype("f8"))


HARMFUL = [
    (bomb, "its size is too small for the 1.2e+10 bytes that 'z' declares"),
    (external, "the values of its variable 'more' are in other files; copy the data into one"),
    (link, "its link 'more' is not a hard link; copy the data into one netCDF-4 file"),
    (virtual, "the values of its variable 'more' are in other files"),
    (circle, "its group '.' belongs to several groups; copy the data into one netCDF-4 file"),
    (lzf, "its variable 'more' is stored by the filter 32000 (lzf); pbdkit applies deflate, "),
    (large_chunk, "its size is too small for the chunks of 2.15e+09 bytes of 'more'"),
    (one_text_for_many, "its attribute 'more' has 50000 elements"),
    (no_texts, "its variable 'more' has values of variable length"),
]


@pytest.mark.parametrize(("change", "message"), HARMFUL, ids=[c.__name__ for c, _ in HARMFUL])
def test_impossible_or_external_contents_are_refused_with_or_without_seal(
    call: Any, tensile: dict[str, Any], change: Any, message: str
) -> None:
    write_field(Path("f.nc"))
    with h5py.File("f.nc", "r+") as file:
        change(file)
    Path("f.json").write_text(json.dumps(with_field(tensile)))
    checked = call("check", "f.json")
    assert checked.code == 2
    assert f"f.nc: {message}" in checked.err

    assert call("run", "e.json", "-o", "r.nc").code == 0
    reseal(Path("r.nc"), change)
    for command in ("explain", "verify"):
        looked = call(command, "r.nc")
        assert looked.code == 6
        assert f"r.nc: {message}" in looked.out + looked.err


def reseal(path: Path, change: Any) -> None:
    """Change a sealed result, and seal it again, which needs no secret."""
    with FileIO(path, "r+b") as file:
        file.truncate(seal_of(file).size)
    with h5py.File(path, "r+") as file:
        change(file)
    with FileIO(path, "r+b") as file:
        put_seal(file)


def test_declared_sizes_of_results_are_within_the_limits(call: Any) -> None:
    """Compressed and not, with texts, dimensions only, and variables that are not written."""
    for n, more in enumerate(([], ["--set", "record.compression=zlib"])):
        assert call("run", "paper/d1", "--set=steps=60", "-o", f"{n}.nc", *more).code == 0
        with h5py.File(f"{n}.nc") as file:
            check_declared(file, Path(f"{n}.nc").stat().st_size)
    with h5py.File("sparse.nc", "w") as file:
        file.create_dataset("position", data=np.random.default_rng(0).random(2**18))
        file.create_dataset("at_end", (2**21,), "f8")
        file.attrs["nothing"] = h5py.Empty(h5py.string_dtype())
        file["nothing"] = h5py.Empty("f8")
        file["a type"] = np.dtype("f8")
        only = file.create_dataset("n", (2**40,), "f4", chunks=(2**10,))
        only.make_scale("This is a netCDF dimension but not a netCDF variable.         5")
    with h5py.File("sparse.nc") as file:
        check_declared(file, Path("sparse.nc").stat().st_size)


PACKED = [
    ({"scale_factor": "abc"}, None),
    ({"add_offset": [1.0, 2.0]}, None),
    ({"_FillValue": 3.0}, "coordinates and values should be finite"),
    ({"scale_factor": 2.0}, ""),
    ({"units": "days since 2000-01-01"}, ""),
]


@pytest.mark.parametrize(("attributes", "message"), PACKED, ids=[str(a) for a, _ in PACKED])
def test_packed_fields_are_unpacked_or_refused_by_file_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, attributes: dict[str, Any], message: str | None
) -> None:
    monkeypatch.chdir(tmp_path)
    write_field(Path("f.nc"), **attributes)
    if message == "":
        scale = attributes.get("scale_factor", 1.0)
        expected = scale * np.arange(1.0, 17.0).reshape(4, 4)
        np.testing.assert_array_equal(read_field(FIELD, OF_PROGRAM).values, expected)
        return
    with pytest.raises(ValueError, match=message) as caught:
        read_field(FIELD, OF_PROGRAM)
    assert str(caught.value).startswith("f.nc: 'E': ")


def test_checksums_in_a_field_file_detect_a_changed_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_field(Path("plain.nc"))
    with xarray.open_dataset("plain.nc", engine="h5netcdf") as field:
        field.to_netcdf("f.nc", encoding={"E": {"fletcher32": True}})
    sound = read_field(FIELD, OF_PROGRAM)
    content = bytearray(Path("f.nc").read_bytes())
    content[content.index(sound.values.tobytes()) + 12] ^= 1
    Path("f.nc").write_bytes(content)
    with pytest.raises(ValueError, match=r"f\.nc: cannot be read as netCDF-4: "):
        read_field(FIELD, OF_PROGRAM)


def test_classic_field_file_is_refused_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("f.nc").write_bytes(b"CDF\x01" + bytes(100))
    with pytest.raises(ValueError, match=r"f\.nc: is not a netCDF-4 file; xarray writes one"):
        read_field(FIELD, OF_PROGRAM)


def test_members_of_a_sweep_read_a_field_once(
    tensile: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_field(Path("f.nc"))
    read, counted = field_file.read_apart, []
    monkeypatch.setattr(field_file, "read_apart", lambda *a: counted.append(a) or read(*a))
    Path("e.json").write_text(json.dumps(with_field(tensile)))
    for steps in (1, 2, 3):
        pbdkit.load("e.json", settings=[f"steps={steps}"])
    assert len(counted) == 1
    write_field(Path("f.nc"), scale_factor=2.0)
    pbdkit.load("e.json")
    assert len(counted) == 2


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of an experiment, beside which files lie."""
    folder = tmp_path / "inner"
    (folder / "below").mkdir(parents=True)
    monkeypatch.chdir(folder)
    for place in (tmp_path, folder / "below"):
        (place / "data.csv").write_text(STEPS)
        write_field(place / "f.nc")
    (folder / "link.csv").symlink_to("../data.csv")
    return folder


OUTSIDE = ("../data.csv", "/data.csv", "link.csv", "below/../../data.csv")


@pytest.mark.parametrize("name", OUTSIDE)
def test_file_outside_the_directory_requires_permission(
    call: Any, tensile: dict[str, Any], elsewhere: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = name.replace("/data.csv", f"{elsewhere.parent}/data.csv") if name[0] == "/" else name
    Path("o.json").write_text(json.dumps(with_table(tensile, name)))
    refused = call("check", "o.json")
    assert refused.code == 2
    assert f"motion.file: {name} lies outside" in refused.err
    assert "copy it there, or allow it with --allow-outside (in Python" in refused.err
    assert call("check", "o.json", "--allow-outside").code == 0
    assert ALLOW_OUTSIDE not in os.environ
    assert pbdkit.load("o.json", allow_outside=True).leaders[1].motion.steps == (1,)
    monkeypatch.setenv(ALLOW_OUTSIDE, "1")
    assert call("check", "o.json").code == 0


def test_files_below_the_directory_and_of_programs_require_none(
    tensile: dict[str, Any], elsewhere: Path
) -> None:
    for parts in (with_table(tensile, "below/data.csv"), with_field(tensile, "below/f.nc")):
        Path("i.json").write_text(json.dumps(parts))
        assert pbdkit.load(Path("i.json")).steps == 10
        os.chdir("below")
        assert pbdkit.load(Path("../i.json")).steps == 10
        os.chdir("..")
    for parts in (with_table(tensile, "../data.csv"), with_field(tensile, f"{elsewhere}/../f.nc")):
        assert pbdkit.Experiment(**parts).steps == 10
        assert pbdkit.analyse(parts).spectral_radius


def test_fields_sweeps_and_fits_require_the_same_permission(
    call: Any, tensile: dict[str, Any], elsewhere: Path
) -> None:
    parts = with_field(tensile, "../f.nc")
    Path("o.json").write_text(json.dumps(parts))
    Path("s.json").write_text(json.dumps({"experiment": parts, "vary": {"steps": [1, 2]}}))
    (elsewhere.parent / "e.json").write_text(json.dumps(tensile))
    Path("t.json").write_text(json.dumps({"experiment": "../e.json", "vary": {"steps": [1, 2]}}))
    fit = {
        "experiment": tensile,
        "unknown": {"rule.K": [0, 1]},
        "measured": {"file": "../data.csv"},
    }
    Path("f.yaml").write_text(json.dumps(fit))
    here = ["--workers", "1"]
    for command, file, *more in (
        ("check", "o.json"),
        ("sweep", "s.json", *here),
        ("sweep", "t.json", *here),
        ("fit", "f.yaml"),
    ):
        refused = call(command, file, *more)
        assert refused.code == 2
        assert "outside the folder" in refused.err or "is not a hard link" in refused.err
        allowed = call(command, file, *more, "--allow-outside")
        assert "--allow-outside" not in allowed.err
        assert (command, allowed.code) in {("check", 0), ("sweep", 0), ("fit", 2)}


@pytest.mark.parametrize(
    "command", ["run", "check", "plot", "identify", "live", "bench", "sweep", "fit"]
)
def test_every_command_that_reads_an_experiment_has_the_option(call: Any, command: str) -> None:
    assert "--allow-outside" in call(command, "--help").out


def test_experiment_with_units_keeps_the_directory_of_its_files(
    tensile: dict[str, Any], elsewhere: Path
) -> None:
    """Its parts are built again as they are written, wherever the program stands by then."""
    parts = with_field(tensile) | {"units": {"length": "1 mm"}}
    Path("below/u.json").write_text(json.dumps(parts))
    found = pbdkit.sweep(
        pbdkit.load("below/u.json"), vary={"steps": [1, 2]}, workers=1, progress=False
    )
    assert found.status.values.tolist() == ["complete"] * 2


def test_sweeps_in_python_vary_files(tensile: dict[str, Any], elsewhere: Path) -> None:
    Path("again.csv").write_text(STEPS)
    files = ["../data.csv", "again.csv"]
    found = pbdkit.sweep(
        with_table(tensile, files[0]),
        vary={"leaders.1.motion": [{"type": "table", "file": file} for file in files]},
        workers=1,
        progress=False,
    )
    assert found.status.values.tolist() == ["complete"] * 2


@pytest.mark.parametrize("parts", [with_table, with_field])
def test_an_experiment_in_a_result_names_no_files(call: Any, parts: Any, elsewhere: Path) -> None:
    assert call("run", "paper/a", "--set=steps=20", "-o", "r.nc").code == 0

    def forge(file: h5py.File) -> None:
        given = json.loads(file.attrs["experiment"])
        file.attrs["experiment"] = json.dumps(parts(given, "below/data.csv"))

    reseal(Path("r.nc"), forge)
    for command in (["explain", "r.nc"], ["resume", "r.nc", "--steps", "999", "--anyway"]):
        refused = call(*command)
        assert refused.code in (2, 6)
        assert "below/data.csv: an experiment in a result" in refused.err


@pytest.mark.parametrize("name", ["a\0b", "x" * 300, "", ".", "/dev/zero", 7])
def test_invalid_file_names_are_refused_in_one_line(tensile: dict[str, Any], name: Any) -> None:
    for parts in (with_table(tensile, name), with_field(tensile, name)):
        with pytest.raises(pbdkit.ExperimentError) as caught:
            pbdkit.Experiment(**parts)
        assert len(str(caught.value)) < 500


TABLES = [
    ("," * 3_000_000 + "\n", r"has a line of more than 65536 characters; remove the columns"),
    (",".join(f"ux{n}" for n in range(9000)) + "\n", "has no 'step'"),
    ("step,ux,uy\n1,1_0,0\n", "d.csv:2: column 'ux' requires a finite number, got '1_0'"),
]


@pytest.mark.parametrize(("content", "message"), TABLES, ids=["wide", "columns", "underscore"])
def test_invalid_tables_are_refused_quickly(
    tensile: dict[str, Any], tmp_path: Path, content: str, message: str
) -> None:
    (tmp_path / "d.csv").write_text(content)
    (tmp_path / "e.json").write_text(json.dumps(with_table(tensile, "d.csv")))
    begun = time.process_time()
    with pytest.raises(pbdkit.ExperimentError, match=message):
        pbdkit.load(tmp_path / "e.json")
    assert time.process_time() - begun < 2.0


def test_sample_of_hostile_files_ends_cleanly(tmp_path: Path) -> None:
    found = hostile_files.attack(3, seed=0, folder=tmp_path, workers=1)
    assert len(found) == 3
    assert [(n, f) for n, outcome in found for f in hostile_files.faults(outcome)] == []
