"""Books of halts: what holds a robot whatever the order in which news comes."""

from __future__ import annotations

from pathlib import Path

import pytest
from fakes import message
from hypothesis import given
from hypothesis import strategies as st

from shared.halts.book import ALL, RELEASE_WITHIN_S, HaltBook, means, new_halt
from shared.halts.keeper import KeptBook
from shared.messages import (
    MAX_HALTS,
    MAX_RELEASED,
    Deadline,
    Halt,
    Halts,
    Release,
    Released,
    Standing,
)

ROBOTS = ("a", "b")
HALTS = st.sampled_from(
    [
        *(Halt(number=number, kind="estop") for number in range(1, 6)),
        *(Halt(number=6 + i, kind="pause", robot=robot) for i, robot in enumerate(ROBOTS)),
    ]
)
RELEASES = st.tuples(st.integers(1, 7), st.sampled_from((ALL, *ROBOTS)))
NEWS = st.lists(HALTS | RELEASES, max_size=30)


def told(news: list[Halt | tuple[int, str]], robot: str = ALL) -> HaltBook:
    """A book that heard of these, in this order."""
    book = HaltBook(robot)
    for item in news:
        if isinstance(item, Halt):
            book.add([item])
        else:
            book.release([item[0]], item[1])
    return book


def naive(news: list[Halt | tuple[int, str]], robot: str) -> set[int]:
    """The numbers that hold a robot: named by a halt for it, and by no release for it."""
    halts = [item for item in news if isinstance(item, Halt)]
    ended = {n for n, whom in (i for i in news if not isinstance(i, Halt)) if whom in (ALL, robot)}
    return {halt.number for halt in halts if halt.robot in (ALL, robot)} - ended


@given(news=NEWS, order=st.randoms(use_true_random=False))
def test_what_holds_a_robot_does_not_depend_on_the_order(
    news: list[Halt | tuple[int, str]], order: object
) -> None:
    shuffled = list(news)
    order.shuffle(shuffled)  # type: ignore[attr-defined]
    for robot in ROBOTS:
        wanted = naive(news, robot)
        for book in (told(news), told(shuffled), told(shuffled, robot)):
            assert {halt.number for halt in book.holding(robot)} == wanted


@given(first=NEWS, second=NEWS)
def test_books_can_be_joined_and_saved(
    first: list[Halt | tuple[int, str]], second: list[Halt | tuple[int, str]]
) -> None:
    book, other = told(first), told(second)
    book.join(other.halts, other.released)
    again = HaltBook()
    again.restore(book.saved())
    for robot in ROBOTS:
        wanted = naive([*first, *second], robot)
        # A halt that no longer concerns anybody is gone from a book, and so cannot come back.
        assert {halt.number for halt in book.holding(robot)} == wanted
        assert again.holding(robot) == book.holding(robot)


def test_a_book_is_bounded() -> None:
    book = HaltBook()
    for number in range(2 * MAX_HALTS):
        book.add(new_halt("estop", ALL, number).halts)
    assert (len(book.halts), book.overflowed) == (MAX_HALTS, MAX_HALTS)
    for number in range(2 * MAX_RELEASED):
        book.release([number], "a")
        book.release([number])
    assert book.halts == ()
    assert len(book.released) == MAX_RELEASED
    assert Released(number=2 * MAX_RELEASED - 1) in book.released


def test_a_release_means_a_life_and_expires() -> None:
    life, other = "0" * 12, "1" * 12
    release = Release(numbers=(1,), deadlines=(Deadline(life=life, until_s=102.0),))
    assert means(release, life, 100.5)
    assert not means(release, other, 100.5)
    assert not means(release, life, 102.1)  # it came late
    assert not means(release, life, 102.0 - RELEASE_WITHIN_S - 0.1)  # of a time yet to come


@pytest.mark.parametrize("robot", ["", "a"])
def test_an_answer_brings_halts_and_releases_none(tmp_path: Path, robot: str) -> None:
    kept = KeptBook(tmp_path, "driver", "a", "1" * 12, robot)
    halt, other = (Halt(number=number, kind="estop") for number in (1, 2))
    kept.hear(Halts(halts=(halt,)))
    told = Released(number=1)
    answer = message(Standing, service="driver", id="a", halts=(other,), released=(told,))
    assert kept.join([answer])
    assert kept.book.halts == (halt, other)
