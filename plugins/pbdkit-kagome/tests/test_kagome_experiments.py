"""The experiments run, and show what the README describes."""

import json
from pathlib import Path

import pbdkit

FOLDER = Path(__file__).parent.parent / "experiments"


def test_the_experiments_run_with_this_plugin():
    files = sorted(FOLDER.glob("*.yaml"))
    assert [file.stem for file in files] == ["honeycomb", "kagome"]
    for file in files:
        ds = pbdkit.run(file, progress=False)
        assert ds.attrs["status"] == "complete"
        assert "pbdkit-kagome" in json.loads(ds.attrs["plugins"])
        pulled = ds.u.isel(time=-1).max()
        assert 1.0 < pulled < 4.0
