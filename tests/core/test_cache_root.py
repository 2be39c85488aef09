"""Where the cache is, with and without a home folder."""

from pathlib import Path

import pytest

from surgicai_vision.core import files


def test_the_variable_comes_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(files.CACHE_VARIABLE, str(tmp_path))
    assert files.cache_root() == tmp_path


def test_then_the_home_folder_if_it_can_be_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv(files.CACHE_VARIABLE)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert files.cache_root() == tmp_path / ".cache" / "surgicai-vision"
    monkeypatch.setenv("HOME", str(tmp_path / "nowhere"))
    assert files.cache_root() == files.CACHE_HERE
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(files.os, "access", lambda path, mode: False)
    assert files.cache_root() == files.CACHE_HERE


def test_a_user_without_a_home_has_one_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv(files.CACHE_VARIABLE)
    monkeypatch.setattr(files.Path, "home", nobody)
    assert files.cache_root() == files.CACHE_HERE


def test_what_stands_in_a_file_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert files.is_writable(tmp_path / "new" / "folder")
    assert not files.is_writable(tmp_path / "file" / "folder")
