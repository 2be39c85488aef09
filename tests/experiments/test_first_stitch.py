"""The first act of a quickstart: it leaves only complete files."""

from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from surgicai_vision.envs import contact_sheet
from surgicai_vision.experiments import first_stitch


def test_a_film_strip_that_is_broken_off_leaves_the_old_one(tmp_path, monkeypatch):
    @contextmanager
    def renderer(*arguments):
        yield lambda state, view: state

    def savefig(path, **options):
        path.write_bytes(b"half")
        assert path.suffix == ".jpg", "it names the format"
        raise OSError("no room")

    monkeypatch.setattr(contact_sheet, "state_renderer", renderer)
    monkeypatch.setattr(contact_sheet, "sheet", lambda *arguments: SimpleNamespace(savefig=savefig))
    strip = tmp_path / first_stitch.STRIP
    strip.write_bytes(b"whole")
    sewer = first_stitch.Sewer(SimpleNamespace(config=None), "expert", "the expert")
    with pytest.raises(OSError, match="no room"):
        first_stitch._strip(sewer, [None], {}, strip)
    assert strip.read_bytes() == b"whole" and list(tmp_path.iterdir()) == [strip]
