"""The messages of a page's stream, each with a JSON header and a binary body.

::

    u32 length of header | u32 length of body | header (UTF-8 JSON) | body          little endian

The header's ``type`` is ``state``, ``news``, ``link`` (whether the daemon is there), ``glimpse`` or ``rows``.
The body of ``rows`` has the kind of each of ``rows`` rows, then their low and then their high values, with
``columns`` values each.
"""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from acquire.web.decimate import Rows

HEAD = struct.Struct("<II")


def message(header: dict[str, Any], body: bytes = b"") -> bytes:
    """Return a binary message: the lengths of both parts, the header as JSON, the body."""
    text = json.dumps(header, separators=(",", ":")).encode()
    return HEAD.pack(len(text), len(body)) + text + body


def json_message(kind: str, facts: str) -> bytes:
    """Return a message without a body; ``facts`` is already JSON."""
    text = f'{{"type":"{kind}","{kind}":{facts}}}'.encode()
    return HEAD.pack(len(text), 0) + text


def rows_message(arm: str, rows: Rows, facts: dict[str, Any]) -> bytes:
    """Return a message with an arm's new rows: their kinds, then lowest and highest values by column."""
    header = {
        "type": "rows",
        "arm": arm,
        "first": rows.first,
        "rows": len(rows.kind),
        "columns": rows.low.shape[1],
        "histogram": rows.histogram.tolist(),
        "saturated": rows.saturated,
        **facts,
    }
    return message(header, rows.kind.tobytes() + rows.low.tobytes() + rows.high.tobytes())
