"""Pictures that are drawn while a run does something else."""

import threading
from pathlib import Path

import pytest

from jaxsense.show.artist import Artist

HERE, THERE = Path("here"), Path("there")


def test_pictures_are_drawn_one_after_the_other_and_sorted_by_where_they_belong():
    threads = []

    def draw(name):
        threads.append(threading.current_thread())
        return {name: b"drawn"}

    with Artist() as artist:
        for path, name in ((HERE, "a.png"), (THERE, "a.png"), (HERE, "b.svg")):
            artist.draw(path, lambda name=name: draw(name))
        found = artist.finished()
    assert found == {HERE: {"a.png": b"drawn", "b.svg": b"drawn"}, THERE: {"a.png": b"drawn"}}
    assert len(set(threads)) == 1
    assert threads[0] is not threading.current_thread()


def test_whoever_wants_the_pictures_hears_why_one_is_not_drawn():
    with Artist() as artist:
        artist.draw(HERE, lambda: {}[0])
        with pytest.raises(KeyError):
            artist.finished()


def test_an_artist_that_leaves_draws_nothing_more():
    begun, go_on = threading.Event(), threading.Event()
    drawn = []

    def wait():
        begun.set()
        go_on.wait()
        return {}

    with Artist() as artist:
        artist.draw(HERE, wait)
        artist.draw(HERE, lambda: drawn.append(1) or {})
        begun.wait()
    go_on.set()
    artist._thread.shutdown(wait=True)
    assert not drawn
