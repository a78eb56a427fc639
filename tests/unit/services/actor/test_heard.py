"""Which life of a robot a session serves, and which announcements of learners it believes."""

from __future__ import annotations

from services.actor.heard import RIVAL_SILENT_S, Newest, ServedLife
from shared.messages import LearnerState, Observation

OLD, NEW = "a" * 12, "b" * 12


def seen(life: str, earlier: tuple[str, ...] = ()) -> Observation:
    return Observation.model_construct(life=life, earlier=earlier)


class Served:
    """A session's view, with the driver's role in our hands."""

    def __init__(self) -> None:
        self.lives = {OLD}
        self.served = ServedLife(lambda: self.lives)
        assert self.served.takes(seen(OLD), 0.0)


def test_another_life_of_the_robot_silences_nobody() -> None:
    rig = Served()
    for moment in range(100):
        assert not rig.served.takes(seen(NEW), 0.01 * moment)
        assert rig.served.takes(seen(OLD), 0.01 * moment)


def test_who_has_the_role_alone_takes_over_at_once() -> None:
    rig = Served()
    rig.lives = {NEW}
    assert rig.served.takes(seen(NEW), 0.1)
    assert not rig.served.takes(seen(OLD), 0.1)


def test_a_life_that_goes_on_with_the_one_before_takes_over_while_both_have_the_role() -> None:
    rig = Served()
    rig.lives = {OLD, NEW}
    assert not rig.served.takes(seen(NEW), 0.1)
    assert rig.served.takes(seen(NEW, (OLD,)), 0.1)


def test_a_liar_that_claims_to_go_on_is_not_served_without_the_role() -> None:
    rig = Served()
    assert not rig.served.takes(seen(NEW, (OLD,)), 0.1)


def test_a_robot_that_speaks_again_after_the_other_fell_silent_is_served_again() -> None:
    rig = Served()
    rig.lives = set()
    late_s = RIVAL_SILENT_S + 0.1
    assert rig.served.takes(seen(NEW), late_s)
    assert not rig.served.takes(seen(OLD), late_s + 0.1)
    assert rig.served.takes(seen(OLD), 2.0 * late_s + 0.1)


def test_a_learner_without_the_role_is_not_believed() -> None:
    newest = Newest()
    true = LearnerState.model_construct(life=OLD)
    assert not newest.note(LearnerState.model_construct(life=NEW), {OLD})
    assert newest.state is None
    assert newest.note(true, {OLD})
    assert newest.state is true
