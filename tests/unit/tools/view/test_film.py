"""The process that writes a movie tells the page how it ended, whatever happens in it."""

from types import SimpleNamespace

import pytest

from rgbmidic.tools.view import panels


def test_an_unexpected_error_is_told_and_not_called_the_end_of_the_process(monkeypatch, tmp_path):
    def broken(*_, **__):
        raise ZeroDivisionError("a fault of ours")

    monkeypatch.setattr(panels, "FieldMovie", broken)
    monkeypatch.setattr(panels.signal, "signal", lambda *_: None)
    told = []
    with pytest.raises(ZeroDivisionError):
        panels._write(SimpleNamespace(send=told.append), None, tmp_path / "movie.gif", ["u"], {"limits": {}})
    ((text, ended),) = told
    assert ended
    assert "movie.gif: unexpected error: ZeroDivisionError: a fault of ours" in text
