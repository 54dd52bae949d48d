"""Of a sequence that is read in order, the next item is computed while the reader works on the last one."""

import threading

import pytest

from gausslite_sim.read_ahead import ReadAhead

COUNT = 24


class Recorder:
    """Computes squares; keeps what was computed, and in which thread."""

    def __init__(self) -> None:
        self.computed: list[int] = []
        self.here: set[int] = set()
        self.done = threading.Condition()

    def __call__(self, i: int) -> int:
        with self.done:
            self.computed.append(i)
            if threading.current_thread() is threading.main_thread():
                self.here.add(i)
            self.done.notify_all()
        if i == 5:
            raise ValueError("item 5")
        return i * i

    def wait_for(self, i: int) -> None:
        with self.done:
            assert self.done.wait_for(lambda: i in self.computed, timeout=30)


@pytest.mark.parametrize(
    ("requested", "ahead"),
    [
        ([0, 1, 2, 3, 4], {2, 3, 4}),
        ([1, 3, 7, 9, 11], {9, 11}),
        ([10, 11, 12, 14, 15, 16], {12, 15, 16}),
        ([7, 3, 20, 4, 18], set()),
        ([20, 21, 22, 23], {22, 23}),
    ],
    ids=["each", "uneven", "held out", "anywhere", "to the end"],
)
def test_items_in_order_are_computed_ahead(requested: list[int], ahead: set[int]) -> None:
    record = Recorder()
    items = ReadAhead(record, COUNT)
    assert [items(i) for i in requested] == [i * i for i in requested]
    assert set(requested) - record.here == ahead
    assert max(record.computed) < COUNT


def test_the_next_item_is_computed_without_a_request() -> None:
    record = Recorder()
    items = ReadAhead(record, COUNT)
    assert (items(0), items(1)) == (0, 1)
    record.wait_for(2)
    assert 2 not in record.here


def test_an_error_comes_with_its_own_item() -> None:
    items = ReadAhead(Recorder(), COUNT)
    assert [items(i) for i in (3, 4)] == [9, 16]
    pytest.raises(ValueError, items, 5).match("item 5")
    assert items(6) == 36
