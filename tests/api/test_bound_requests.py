"""What the requests of a lock mean is remembered by their ids, and keeps nothing alive."""

import gc
import weakref

import pytest

from enact_dist import Aspect, Entity, Lock, Read, Write, local

A, B, C = Aspect("a", int), Aspect("b", int), Aspect("c", int)
X = Entity("x")


@pytest.fixture
def no_collector():
    """Only reference counts free objects."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def test_dropped_cell_ends_with_its_last_reference(no_collector):
    """A session that remembers requests, which name its contexts, is no cycle."""
    cell = local(worlds=["online"])
    online = cell.world("online")
    request = Write(online, X, A)
    for number in range(2):
        with Lock(request) as lock:
            lock[request] = number
    client = weakref.ref(cell._client)
    cell.close()

    del cell, online, request, lock

    assert client() is None


def test_sets_are_forgotten_with_their_requests():
    """Requests that are made anew for each lock pile up nowhere."""
    with local(worlds=["online"]) as cell:
        online = cell.world("online")
        cell.world("online").init(X, A, 0)
        for _ in range(20):
            with Lock(Read(online, X, A)) as lock:
                pass
            del lock

        assert len(online.session.bound) <= 1


def test_id_that_is_used_again_names_the_new_request():
    """Of three equal requests a lock needs one; the others may be freed at any time."""
    with local(worlds=["online"]) as cell:
        online = cell.world("online")
        online.init(X, A, 1)
        online.init(X, B, 2)
        first, last = Read(online, X, A), Read(online, X, A)
        with Lock(first, Read(online, X, A), last) as lock:
            assert lock[last] == 1
            others = [Read(online, X, B) for _ in range(50)]  # one of them may have the freed id
        for other in others:
            with Lock(first, other, last) as lock:
                assert lock[other] == 2


def test_equal_request_is_found_whichever_object_names_it():
    """By its id where it is the same object, else by what it says."""
    with local(worlds=["online"]) as cell:
        online = cell.world("online")
        online.init(X, C, 7)
        with Lock(Write(online, X, C)) as lock:
            lock[Write(online, X, C)] += 1
        with Lock(Read(online, X, C)) as lock:
            assert lock[Read(online, X, C)] == 8
