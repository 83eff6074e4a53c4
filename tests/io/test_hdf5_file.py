import h5py
import numpy as np
import pytest

from pbdkit import memory
from pbdkit.io.hdf5_file import Hdf5File


def test_no_file_is_opened_without_memory_for_its_cache(tmp_path, monkeypatch):
    """The library would read a null pointer."""
    monkeypatch.setattr(memory, "FILE_CACHE", 2**60)
    with pytest.raises(MemoryError):
        Hdf5File(tmp_path / "a.h5", "w")
    assert list(tmp_path.iterdir()) == []


def test_objects_are_looked_up_once_and_anew_after_a_deletion(tmp_path, monkeypatch):
    opened = []
    open_object = h5py.Group._get
    monkeypatch.setattr(
        h5py.Group, "_get", lambda self, name: opened.append(name) or open_object(self, name)
    )
    with Hdf5File(tmp_path / "a.h5", "w") as file:
        file.create_group("g")["x"] = np.arange(3)
        opened.clear()
        for _ in range(5):
            assert file["/g/x"][-1] == 2
        assert opened == ["/g/x"]
        assert file["/"]["g/x"].shape == file["/"][file["/g/x"].ref].shape == (3,)
        file["a"] = np.arange(3)
        assert file["/a"][-1] == 2
        del file["/"]["a"]
        file["a"] = np.arange(5)
        assert file["/a"][-1] == 4
