"""The figures of a run for Prometheus: every number of the newest heartbeats."""

from collections.abc import Iterable

from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from services.page.watch import Watch


class Figures(Collector):
    """Gauges named `corridor_<kind of heartbeat>_<field>`, and some of what the page itself saw."""

    def __init__(self, watch: Watch) -> None:
        self._watch = watch

    def collect(self) -> Iterable[GaugeMetricFamily]:
        """Yield every figure; of what nobody has told yet there is none."""
        found: dict[str, GaugeMetricFamily] = {}

        def add(name: str, value: object, /, **labels: str) -> None:
            if isinstance(value, int | float):
                family = found.setdefault(name, GaugeMetricFamily(name, name, labels=[*labels]))
                family.add_metric([*labels.values()], float(value))

        for who, entry in self._watch.snapshot.everybody.items():
            kind = type(entry.message).__name__.removesuffix("State").lower()
            robot = getattr(entry.message, "robot", "")
            add("corridor_heartbeat_age_seconds", entry.age_s, service=who)
            for field, value in entry.message:
                add(f"corridor_{kind}_{field}", value, **({"robot": robot} if robot else {}))
            for told in getattr(entry.message, "retention", ()):
                add("corridor_replay_retention", told.value, name=told.name)
            for action, count in enumerate(getattr(entry.message, "by_action", ())):
                add("corridor_replay_by_action", count, action=str(action))
        for robot, track in list(self._watch.tracks.items()):
            for quantile, delay_ms in zip(("0.5", "0.95"), track.latency_ms(), strict=False):
                name = "corridor_action_latency_seconds"
                add(name, delay_ms / 1e3, robot=robot, quantile=quantile)
        add("corridor_page_browsers", self._watch.browsers)
        add("corridor_page_lost_messages", self._watch.lost)
        return found.values()
