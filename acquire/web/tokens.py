"""Who may enter: a token for those who steer and one for those who look, in a file that only its owner reads.

A browser exchanges the token for a cookie, which scripts of other pages can neither read nor have sent. The
cookie is made of the token (HMAC): it is good as long as the token is, whatever process serves the page. To
change the tokens, delete the file.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import stat
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from acquire.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

Role = Literal["operator", "viewer"]
ROLES: tuple[Role, ...] = ("operator", "viewer")
COOKIE = "acquire_session"
_TOKEN_BYTES = 24
_MOST_BYTES = 4096


@dataclass(frozen=True, slots=True, repr=False)
class Tokens:
    """By role."""

    operator: str
    viewer: str

    def role_of_token(self, token: str) -> Role | None:
        return self._find(token, self._of)

    def role_of_cookie(self, cookie: str) -> Role | None:
        return self._find(cookie, self.cookie)

    def cookie(self, role: Role) -> str:
        """What a browser gets for the token."""
        return hmac.new(self._of(role).encode(), f"session {role}".encode(), hashlib.sha256).hexdigest()

    def _of(self, role: Role) -> str:
        return self.operator if role == "operator" else self.viewer

    def _find(self, given: str, right: object) -> Role | None:
        """In constant time for each role."""
        found: Role | None = None
        for role in ROLES:  # both, whichever fits; as bytes, since text that is not ASCII is refused
            if hmac.compare_digest(given.encode(), right(role).encode()):  # type: ignore[operator]
                found = role
        return found


def load_tokens(path: Path) -> Tokens:
    """The tokens in ``path``, made where there is no file. Raises UsageError where others may read it."""
    # Its owner's alone from the first moment, and never written over: O_EXCL does not follow a link either.
    try:
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError:
        return _read(path)
    except OSError as error:
        raise UsageError(
            f"the file of tokens {path} cannot be opened: {error.strerror}", hint="web.token_file"
        ) from error
    made = {role: secrets.token_urlsafe(_TOKEN_BYTES) for role in ROLES}
    with os.fdopen(file, "w") as out:
        json.dump(made, out)
    return Tokens(**made)


def _read(path: Path) -> Tokens:
    odd = UsageError(f"the file of tokens {path} is not one of ours", hint="delete it: a new one is made")
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        raise UsageError(
            f"the file of tokens {path} cannot be opened: {error.strerror}", hint="web.token_file"
        ) from error
    with os.fdopen(file, "rb") as source:
        found = os.fstat(file)
        if not stat.S_ISREG(found.st_mode):
            raise odd
        if found.st_uid != os.geteuid() or stat.S_IMODE(found.st_mode) & 0o077:
            raise UsageError(
                f"the file of tokens {path} can be read by others (mode {stat.S_IMODE(found.st_mode):04o})",
                hint=f"delete it: a new one is made; or chmod 600 {path}, if nobody has read it",
            )
        content = source.read(_MOST_BYTES)
    try:
        table = json.loads(content)
        tokens = Tokens(str(table["operator"]), str(table["viewer"]))
    except (ValueError, KeyError, TypeError) as error:
        raise odd from error
    if min(len(tokens.operator), len(tokens.viewer)) < _TOKEN_BYTES or tokens.operator == tokens.viewer:
        raise odd
    return tokens
