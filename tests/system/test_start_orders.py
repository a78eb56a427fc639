"""Services start in any order, with the router first or last, and come to drive."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from cluster import SERVICES, Cluster, make_config

from shared.keys import ACTION
from shared.messages import Action

START_LIMIT_S = 20
"""From the last start to the first action."""
pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]
ORDERS = list(itertools.permutations(SERVICES))


@pytest.mark.parametrize("router_first", [True, False], ids=["router-first", "router-last"])
@pytest.mark.parametrize("order", ORDERS, ids=["-".join(order) for order in ORDERS])
def test_first_action_comes_whatever_the_order(
    order: tuple[str, ...], router_first: bool, tmp_path: Path
) -> None:
    names = ("router", *order) if router_first else (*order, "router")
    with Cluster(make_config("orders"), tmp_path / "run") as cluster:
        for name in names:
            cluster.start(name)
        inbox = cluster.bus.inbox()
        inbox.subscribe(ACTION)
        cluster.wait(lambda: bool(inbox.take(ACTION, Action)), START_LIMIT_S, "first action")


def test_orders_are_all_there_are() -> None:
    assert len(ORDERS) == 24
