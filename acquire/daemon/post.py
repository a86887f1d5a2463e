"""One webhook: a process that posts its input to the URL in the first line of it, or prints why it failed.

A process, since a thread cannot be given up: urllib limits each wait, but neither the search for the host's
address nor the number of waits, and a server may send its answer byte by byte.
"""

from __future__ import annotations

import http.client
import signal
import sys
import urllib.request


def main(limit_s: float) -> str | None:
    """Post the input as JSON; return the reason if that failed. SIGALRM ends it after ``limit_s``."""
    # A limit of its own, also for a process whose daemon has ended in the meantime.
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    # The URL is not an argument, which every user of the host can see: some webhooks have a secret in it.
    url, _, text = sys.stdin.buffer.read().partition(b"\n")
    headers = {"Content-Type": "application/json"}
    request = urllib.request.Request(url.decode(), text, headers)  # noqa: S310 - http, checked
    try:
        with urllib.request.urlopen(request, timeout=limit_s):  # noqa: S310 - as above
            return None
    except OSError as error:
        return str(error)
    except http.client.HTTPException as error:  # the port is another service's, or that of https
        return f"the answer is not HTTP: {error!r}"
    except UnicodeError:  # its text would quote the URL's path, which may be a secret
        return "the URL has a letter that is not ASCII: write it as %XX"


if __name__ == "__main__":
    failure = main(float(sys.argv[1]))
    if failure is not None:
        sys.stdout.write(failure)
        sys.exit(1)
