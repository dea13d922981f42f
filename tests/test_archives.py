"""Archives of one name in two directories are told apart."""

import sys
import zipfile

from archives import imports_from_archives


def test_an_archive_of_another_directory_is_forgotten(tmp_path, monkeypatch):
    for size in (100_000, 10):
        (tmp_path / str(size)).mkdir()
        monkeypatch.chdir(tmp_path / str(size))
        with zipfile.ZipFile("robot.zip", "w") as file:
            file.writestr("weights.npz", bytes(size))
            file.writestr("robot_numpy.py", f"size = {size}")
        monkeypatch.setattr(sys, "path", ["robot.zip", *sys.path])
        # The first import is one that nobody forgets.
        if size > 10:
            __import__("robot_numpy")
        else:
            with imports_from_archives():
                assert __import__("robot_numpy").size == size
