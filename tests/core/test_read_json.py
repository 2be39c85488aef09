"""JSON files: what cannot be read is refused in one line."""

import pytest

from surgicai_vision.core.errors import BadFile
from surgicai_vision.core.files import read_json


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"{", "not valid JSON"),
        (b"\xff\xfe\x00", "not valid JSON"),
        (b"[" * 100_000, "nested too deeply"),
        (b'{"a":' * 100_000, "nested too deeply"),
    ],
)
def test_what_is_no_json_is_refused(tmp_path, content, told):
    path = tmp_path / "given.json"
    path.write_bytes(content)
    with pytest.raises(BadFile, match=told) as refused:
        read_json(path)
    assert str(path) in str(refused.value) and "\n" not in str(refused.value)
