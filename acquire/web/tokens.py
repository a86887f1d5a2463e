"""Access tokens of operators and viewers, in a file that only its owner can read.

A browser exchanges the token for a cookie, which scripts of other pages can neither read nor make it send.
The cookie is derived from the token (HMAC), so that it is valid as long as the token is, whichever process
serves the page. To change the tokens, delete the file: a running page notices it (`TokenFile`).
"""

from __future__ import annotations

import hashlib
import hmac
import json
import logging
import os
import secrets
import stat
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from acquire.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

Role = Literal["operator", "viewer"]
ROLES: tuple[Role, ...] = ("operator", "viewer")
COOKIE = "acquire_session"
# 192 random bits, which base64 writes as 32 characters: guessing them is hopeless even without a limit.
_TOKEN_BYTES = 24
_MOST_BYTES = 4096
"""More than a file of tokens has: any other file in its place is not read to its end."""
LOOK_EVERY_S = 1.0
"""Interval at which the file is looked at for new tokens."""

log = logging.getLogger("acquire.web")


@dataclass(frozen=True, slots=True, repr=False)
class Tokens:
    """One token per role."""

    operator: str
    viewer: str

    def role_of_token(self, token: str) -> Role | None:
        """Return the role of a token; None for a wrong one."""
        return self._find(token, self._of)

    def role_of_cookie(self, cookie: str) -> Role | None:
        """Return the role of a browser's cookie; None for a wrong one."""
        return self._find(cookie, self.cookie)

    def cookie(self, role: Role) -> str:
        """Return the cookie that a browser gets for the token."""
        return hmac.new(self._of(role).encode(), f"session {role}".encode(), hashlib.sha256).hexdigest()

    def taken_out_of(self, text: str) -> str:
        """Return a text without the tokens, which a viewer must not find in what somebody else wrote."""
        return text.replace(self.operator, "…").replace(self.viewer, "…")

    def _of(self, role: Role) -> str:
        return self.operator if role == "operator" else self.viewer

    def _find(self, given: str, right: object) -> Role | None:
        """Return the role whose secret is ``given``, compared in constant time."""
        found: Role | None = None
        # Both roles are compared, even after a match. As bytes, since str must be ASCII for compare_digest.
        for role in ROLES:
            if hmac.compare_digest(given.encode(), right(role).encode()):  # type: ignore[operator]
                found = role
        return found


class TokenFile:
    """The tokens of a file as it is now: whoever deletes it wants the old ones to be invalid."""

    def __init__(self, path: Path) -> None:
        """Read or create the file. Raises UsageError as `load_tokens` does."""
        self._path = path
        self._tokens = load_tokens(path)
        self._stamp, self._looked_s = _stamp(path), time.monotonic()

    def role_of_token(self, token: str) -> Role | None:
        return self.current.role_of_token(token)

    def role_of_cookie(self, cookie: str) -> Role | None:
        return self.current.role_of_cookie(cookie)

    def cookie(self, role: Role) -> str:
        return self.current.cookie(role)

    def taken_out_of(self, text: str) -> str:
        return self.current.taken_out_of(text)

    @property
    def current(self) -> Tokens:
        """The tokens of a moment ago. Those of a file that has become invalid stay valid."""
        now_s = time.monotonic()
        if now_s - self._looked_s >= LOOK_EVERY_S:
            self._looked_s = now_s
            stamp = _stamp(self._path)
            if stamp is None or stamp != self._stamp:
                try:
                    self._tokens = load_tokens(self._path)
                except UsageError as error:
                    log.warning("%s; the tokens from before stay valid", error)
                else:
                    log.info("the tokens were changed: %s", self._path)
                self._stamp = _stamp(self._path)
        return self._tokens


def _stamp(path: Path) -> tuple[int, int] | None:
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns


def load_tokens(path: Path) -> Tokens:
    """Read the tokens from ``path``, or create it. Raises UsageError if others may read it."""
    try:
        if not os.path.lexists(path):
            _create(path)
    except OSError as error:
        raise UsageError(
            f"the token file {path} cannot be created: {error.strerror}", hint="web.token_file"
        ) from error
    # Read in any case: another process may have been faster.
    return _read_tokens(path)


def _create(path: Path) -> None:
    """Create the file as a whole, unless there is one by then. Raises OSError."""
    text = json.dumps({role: secrets.token_urlsafe(_TOKEN_BYTES) for role in ROLES}).encode()
    # Under another name first: a full disk, or a kill, would leave a file that is not valid, and who reads it
    # in between would find one. Only the owner can ever read it.
    scratch = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        file = os.open(scratch, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with os.fdopen(file, "wb") as out:
            out.write(text)
            out.flush()
            os.fsync(out.fileno())
        try:
            os.link(scratch, path)  # neither overwrites an existing one nor follows a link
        except FileExistsError:
            return
        except OSError:  # a file system without hard links
            scratch.rename(path)
    finally:
        scratch.unlink(missing_ok=True)


def _read_tokens(path: Path) -> Tokens:
    invalid = UsageError(
        f"the token file {path} is not valid", hint="delete it, and a new one will be created"
    )
    try:
        # A link could lead to somebody else's file, and a named pipe would wait for who writes into it.
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        raise UsageError(
            f"the token file {path} cannot be opened: {error.strerror}", hint="web.token_file"
        ) from error
    with os.fdopen(file, "rb") as source:
        status = os.fstat(file)
        # Of the open file, and not of its name, which could be replaced in between.
        if not stat.S_ISREG(status.st_mode):
            raise invalid
        if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o077:
            raise UsageError(
                f"the token file {path} can be read by others (mode {stat.S_IMODE(status.st_mode):04o})",
                hint=f"delete it, and a new one will be created; or chmod 600 {path}, if nobody has read it",
            )
        content = source.read(_MOST_BYTES)
    try:
        table = json.loads(content)
        tokens = Tokens(str(table["operator"]), str(table["viewer"]))
    except (ValueError, KeyError, TypeError) as error:
        raise invalid from error
    if min(len(tokens.operator), len(tokens.viewer)) < _TOKEN_BYTES or tokens.operator == tokens.viewer:
        raise invalid
    return tokens
