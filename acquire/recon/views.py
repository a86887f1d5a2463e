"""Pictures as either arm sees them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from acquire.arrays import HOST
from acquire.forward import blurring, registration

if TYPE_CHECKING:
    from acquire.arrays import Array, Arrays
    from acquire.lines import Segment


def seen_by_arms(
    segment: Segment, pictures: Array, spatial_merge: int = 1, arrays: Arrays = HOST
) -> tuple[Array, Array]:
    """Pictures (k, n′, n′) as arms A and B see them, displaced and blurred, with the axes of the scene."""
    alignment, blur, geometry = segment.alignment, segment.blur, segment.geometry
    view_a = view_b = pictures
    if (moved := registration(alignment, geometry, spatial_merge, arrays)) is not None:
        view_b = moved.forward(view_b)
    if (blurred := blurring(blur, geometry, spatial_merge, arrays)) is not None:
        view_a, view_b = blurred.forward(0, view_a), blurred.forward(1, view_b)
    return view_a, view_b
