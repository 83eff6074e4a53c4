"""The first calls of Python users, and what is said of wrong ones."""

import inspect
import subprocess
import sys

import pytest

import pbdkit

SMALL = ["steps=4", "record.every=2"]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("calls") / "a.nc"
    pbdkit.run(pbdkit.load("paper/a", settings=SMALL), progress=False).to_netcdf(path)
    return path


@pytest.fixture(scope="module")
def ds(file):
    import xarray

    return xarray.load_dataset(file)


@pytest.mark.parametrize("order", ["import pbdkit, xarray", "import xarray, pbdkit"])
def test_what_xarray_opens_has_the_accessor(file, order):
    check = "import sys; ds = xarray.open_dataset(sys.argv[1]); print(ds.pbd.at(i=4, j=5).number)"
    command = [sys.executable, "-c", f"{order}; {check}", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    assert "number" in done.stdout


def test_importing_pbdkit_imports_no_xarray_and_looking_for_it_registers_nothing():
    check = (
        "import sys, pbdkit, importlib.util as u; assert u.find_spec('xarray');"
        "assert 'xarray' not in sys.modules and 'numpy' not in sys.modules;"
        "import xarray; print(hasattr(xarray.Dataset, 'pbd'), len([f for f in sys.meta_path"
        " if type(f).__module__.startswith('pbdkit')]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", check], capture_output=True, text=True, timeout=100
    )
    assert (done.stdout.strip(), done.stderr) == ("True 0", "")


@pytest.mark.parametrize("name", ["plot", "compare", "animate", "animation"])
def test_signatures_name_their_options_as_matplotlib_does(ds, name):
    parameters = inspect.signature(getattr(ds.pbd, name)).parameters
    assert {"color", "cmap", "vmin", "vmax", "figsize", "dpi"} <= {*parameters}
    assert not any(p.kind is p.VAR_KEYWORD for p in parameters.values())


def test_one_limit_of_the_colours_leaves_the_other_to_the_values(ds):
    bar = ds.pbd.plot("pe1", vmax=7.0).figure.axes[1]
    lowest = float(ds.pe1.isel(time=-1).min())
    assert max(bar.get_xlim(), bar.get_ylim(), key=max) == pytest.approx((lowest, 7.0))
