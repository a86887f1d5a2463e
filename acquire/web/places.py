"""The shape of a ring, from the daemon's description."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.stream.ring import RingShape

if TYPE_CHECKING:
    from acquire.daemon.facts import RingPlace


def shape_of(place: RingPlace) -> RingShape:
    facts = place.model_dump()
    del facts["path"]
    return RingShape(**facts)
