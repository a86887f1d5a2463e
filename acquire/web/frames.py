"""What travels to a page: framed messages on one stream, a header in JSON and a body in bytes.

::

    u32 length of header | u32 length of body | header (UTF-8 JSON) | body          little endian

The header's ``type`` is ``status``, ``news``, ``link`` (the daemon is there, or not) or ``rows``: the body of
that is, for each of ``rows`` rows, its kind; then their low and then their high values, ``columns`` each.
"""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from acquire.web.decimate import Rows

HEAD = struct.Struct("<II")


def message(header: dict[str, Any], body: bytes = b"") -> bytes:
    text = json.dumps(header, separators=(",", ":")).encode()
    return HEAD.pack(len(text), len(body)) + text + body


def json_message(kind: str, facts: str) -> bytes:
    """``facts`` is JSON already."""
    text = f'{{"type":"{kind}","{kind}":{facts}}}'.encode()
    return HEAD.pack(len(text), 0) + text


def rows_message(arm: str, rows: Rows, facts: dict[str, Any]) -> bytes:
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
