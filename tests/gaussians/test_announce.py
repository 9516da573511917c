"""The first compilation is announced once; what is compiled already is not."""

import numba

from extrap_train.gaussians import rasterize


def test_says_once_that_it_compiles(caplog, monkeypatch):
    monkeypatch.setattr(rasterize, "_ANNOUNCER", rasterize._Announcer())
    kernel = numba.njit(lambda x: x + 1)
    for argument in (1, 1, 1.0):
        with rasterize.announce_compilation():
            kernel(argument)
    assert caplog.text.count("compiling the CPU rasteriser") == 1


def test_is_silent_when_nothing_is_compiled(caplog, monkeypatch):
    kernel = numba.njit(lambda x: x * 2)
    kernel(1)
    monkeypatch.setattr(rasterize, "_ANNOUNCER", rasterize._Announcer())
    with rasterize.announce_compilation():
        kernel(1)
    assert not caplog.text
