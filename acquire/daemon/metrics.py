"""The status for Prometheus: one prefix, base units, counters that end in _total.

A counter restarts from 0 with every run, which Prometheus handles as a reset.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4 as CONTENT_TYPE
from prometheus_client.registry import Collector

from acquire.daemon.states import State

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from prometheus_client.core import Metric

    from acquire.daemon.facts import Health
    from acquire.daemon.messages import Status

__all__ = ["CONTENT_TYPE", "metrics_text"]


def metrics_text(status: Status, health: Health) -> bytes:
    """Return the metrics in the text format."""
    # For this one answer. Describing it first, as registries do, would collect everything twice.
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Metrics(status, health))
    return generate_latest(registry)


class _Metrics(Collector):
    def __init__(self, status: Status, health: Health) -> None:
        self._status = status
        self._health = health

    def collect(self) -> Iterable[Metric]:
        yield from self._of_service()
        yield from self._of_arms()
        yield from self._of_places()

    def _of_service(self) -> Iterator[Metric]:
        status = self._status
        yield _gauge(
            "acquire_build_info",
            "A constant 1 with version and rig.",
            [((status.version, status.name), 1)],
            "version rig",
        )
        states = [((str(state),), int(status.state is state)) for state in State]
        yield _gauge("acquire_state", "1 for the state that the daemon is in.", states, "state")
        levels = ("idle", "good", "degraded", "lost", "fault")
        found = [((level,), int(self._health.level == level)) for level in levels]
        yield _gauge("acquire_health", "1 for the level of health.", found, "level")
        yield _gauge("acquire_uptime_seconds", "Time since the daemon began.", [((), status.uptime_s)])
        troubles = sum(one.times for one in status.troubles)
        yield _counter("acquire_troubles", "Unforeseen failures outside commands.", [((), troubles)])
        if status.trigger is not None:
            yield _gauge(
                "acquire_trigger_silent_seconds",
                "Time since the trigger last sent anything.",
                [((), status.trigger.silent_s)],
            )

    def _of_arms(self) -> Iterator[Metric]:
        arms = self._status.arms
        if not arms:
            return
        fates = [
            ((arm, fate), getattr(facts.ledger, fate))
            for arm, facts in arms.items()
            if facts.ledger is not None
            for fate in ("issued", "preroll", "stored", "discarded")
        ]
        yield _counter("acquire_lines", "Lines since the instrument was armed, by fate.", fates, "arm fate")
        lost = [((arm, cause), n) for arm, facts in arms.items() for cause, n in facts.lost.items()]
        yield _counter("acquire_lines_lost", "Lines lost since it was armed, by cause.", lost, "arm cause")
        saturated = [((arm,), facts.saturated) for arm, facts in arms.items()]
        yield _counter("acquire_saturated_lines", "Lines with a saturated pixel.", saturated, "arm")
        rates = [((arm,), facts.rate_hz) for arm, facts in arms.items()]
        yield _gauge("acquire_line_rate_hertz", "Lines delivered, over five seconds.", rates, "arm")
        fills = [((arm,), facts.ring.fill / facts.ring.slots) for arm, facts in arms.items()]
        yield _gauge("acquire_ring_fill_ratio", "Share of the ring not recorded yet.", fills, "arm")
        verified = [
            ((arm,), int(facts.check.verdict == "verified")) for arm, facts in arms.items() if facts.check
        ]
        yield _gauge("acquire_code_verified", "1 while the light follows the code.", verified, "arm")
        balanced = [((arm,), int(facts.ledger.balanced)) for arm, facts in arms.items() if facts.ledger]
        yield _gauge("acquire_ledger_balanced", "1 while every pulse is accounted for.", balanced, "arm")

    def _of_places(self) -> Iterator[Metric]:
        status = self._status
        usable = int(status.disk_trouble is None)
        yield _gauge("acquire_directory_usable", "1 while recordings can begin there.", [((), usable)])
        if (disk := status.disk) is not None:
            yield _gauge("acquire_disk_free_bytes", "Free on the recordings' disk.", [((), disk.free_bytes)])
            yield _gauge(
                "acquire_disk_full_seconds", "Time until the disk is full.", [((), disk.seconds_to_full)]
            )
        if status.capacity is not None and status.capacity.sustained_hz is not None:
            yield _gauge(
                "acquire_capacity_sustained_hertz",
                "Lines that this host sustains, as measured before arming.",
                [((), status.capacity.sustained_hz)],
            )
        if (now := status.recording) is not None:
            waiting = now.recorded_lines - now.committed_lines
            yield _gauge("acquire_uncommitted_lines", "Lines not readable yet.", [((), waiting)])
            if now.commit_age_s is not None:
                age = [((), now.commit_age_s)]
                yield _gauge("acquire_commit_age_seconds", "Time since lines last became readable.", age)
            yield _gauge(
                "acquire_held_beyond_limit_bytes",
                "Bytes above recording.retention.max_gb that are kept because lines are held.",
                [((), now.beyond_bytes)],
            )
        yield _gauge(
            "acquire_upload_pending_recordings", "Recordings not copied yet.", [((), status.uploads_left)]
        )


def _gauge(
    name: str, what: str, samples: Sequence[tuple[tuple[str, ...], float]], labels: str = ""
) -> Metric:
    family = GaugeMetricFamily(name, what, labels=labels.split())
    for values, number in samples:
        family.add_metric(values, number)
    return family


def _counter(
    name: str, what: str, samples: Sequence[tuple[tuple[str, ...], float]], labels: str = ""
) -> Metric:
    family = CounterMetricFamily(name, what, labels=labels.split())
    for values, number in samples:
        family.add_metric(values, number)
    return family
