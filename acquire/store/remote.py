"""Remote recordings: anything that fsspec reaches, with obstore for object stores (S3, Google, Azure).

Credentials and endpoints come from the environment, as those stores document it (AWS_ENDPOINT and the like);
they are never written anywhere. Without any, a store is refused at once: obstore would query the metadata
service of cloud machines, which no other machine can reach, and wait for it.
"""

from __future__ import annotations

import importlib.util
import os
import re
from contextlib import contextmanager
from datetime import timedelta
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acquire.errors import PlaceError, StoreError, UsageError
from acquire.place import home
from acquire.store.place import put_bytes, put_copy
from acquire.text import shortened

if TYPE_CHECKING:
    from collections.abc import Iterator

    from zarr.abc.store import Store

OBJECT_STORES = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss")
RETRY = {"max_retries": 4, "retry_timeout": timedelta(seconds=30)}
"""For how long requests are repeated if a store does not answer."""
_ATTEMPTS = re.compile(r" in [\d.]+\w+, after \d+ retries, max_retries: \d+, retry_timeout: \w+ ?")
"""obstore's account of the retries, which is different each time and is removed from messages."""
_STATUS = re.compile(r"status code: (\d+)")
_STATUS_ERRORS: dict[str, type[OSError]] = {
    "401": PermissionError,
    "403": PermissionError,
    "404": FileNotFoundError,
}

# A metadata service counts only if it is named.
WAYS_IN = {
    "s3": (
        ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"),
        ("AWS_WEB_IDENTITY_TOKEN_FILE",),
        ("AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",),
        ("AWS_CONTAINER_CREDENTIALS_FULL_URI",),
        ("AWS_SKIP_SIGNATURE",),
        ("AWS_METADATA_ENDPOINT",),
    ),
    "gs": (
        ("GOOGLE_APPLICATION_CREDENTIALS",),
        ("GOOGLE_SERVICE_ACCOUNT",),
        ("GOOGLE_SERVICE_ACCOUNT_PATH",),
        ("GOOGLE_SERVICE_ACCOUNT_KEY",),
        ("GOOGLE_SKIP_SIGNATURE",),
        ("GCE_METADATA_HOST",),
    ),
    "az": (
        ("AZURE_STORAGE_ACCOUNT_KEY",),
        ("AZURE_STORAGE_ACCESS_KEY",),
        ("AZURE_STORAGE_SAS_TOKEN",),
        ("AZURE_STORAGE_SAS_KEY",),
        ("AZURE_STORAGE_TOKEN",),
        ("AZURE_STORAGE_CLIENT_ID",),
        ("AZURE_CLIENT_ID",),
        ("AZURE_FEDERATED_TOKEN_FILE",),
        ("AZURE_USE_AZURE_CLI",),
        ("AZURE_STORAGE_USE_EMULATOR",),
        ("AZURE_SKIP_SIGNATURE",),
        ("AZURE_MSI_ENDPOINT",),
        ("IDENTITY_ENDPOINT",),
    ),
}
"""Kind of object store → groups of environment variables, each of which gives access."""
_FAMILIES = {"s3a": "s3", "gcs": "gs", "abfs": "az", "abfss": "az"}
_GOOGLE_FILE = ".config/gcloud/application_default_credentials.json"

PATIENCE = "120s"
PROOF = ".acquire"
"""Key of a small file next to the recordings, written to test whether that is possible."""


def be_patient() -> None:
    """Give each request of this process the time that a slow store needs, unless the environment sets it.

    An upload has a dozen parts of 5 MB under way at once: with `PATIENCE` for each, a store that takes
    0.5 MB/s suffices. obstore's default of 30 s requires 2 MB/s: a slower store never gets a large part.
    """
    for store in ("AWS", "GOOGLE", "AZURE"):
        os.environ.setdefault(f"{store}_TIMEOUT", PATIENCE)


def is_url(place: Path | str) -> bool:
    """Whether a place is meant as a URL."""
    return isinstance(place, str) and "://" in place


def url_below(target: str, path: Path) -> str:
    """Return the URL below ``target`` of the copy of the recording at ``path``."""
    return f"{target}/{path.name}"


def shares_disk(url: str | None, directory: Path) -> bool:
    """Whether a copy to ``url`` goes to the disk of ``directory``, where each line then takes room twice."""
    kind, _, place = (url or "").partition("://")
    if kind not in ("file", "local"):
        return False
    try:
        # The directory of the copies may not exist yet.
        there = next(path for path in (Path(place), *Path(place).parents) if path.exists())
        return there.stat().st_dev == directory.stat().st_dev
    except (OSError, StopIteration):
        return False


class RemoteSource:
    """Bytes below a URL; see `source.Source`. Every failure is an OSError."""

    def __init__(self, url: str) -> None:
        """Open the URL.

        Raises UsageError for an invalid URL or one whose packages are not installed, PlaceError for an object
        store without credentials in the environment, and StoreError if a server that is asked at once, as
        ftp's and sftp's are, cannot be reached.
        """
        self.url = url.rstrip("/")
        check_url(self.url)
        _check_credentials(self.url)
        import fsspec

        with _url_errors(self.url):
            self._fs, self._root = fsspec.core.url_to_fs(self.url, **_options(self.url))

    def __str__(self) -> str:
        return self.url

    def read(self, key: str) -> bytes:
        with _as_os_errors():
            data: bytes = self._fs.cat_file(self._path(key))
            return data

    def read_range(self, key: str, start: int, size: int) -> bytes:
        with _as_os_errors():
            data: bytes = self._fs.cat_file(self._path(key), start=start, end=start + size)
            return data

    def expect(self, key: str, start: int, size: int) -> None:
        """Do nothing: remote data are not fetched ahead."""

    def size(self, key: str) -> int:
        with _as_os_errors():
            return int(self._fs.info(self._path(key))["size"])

    def names(self, key: str) -> list[str]:
        with _as_os_errors():
            try:
                found = self._fs.ls(self._path(key), detail=False)
            except (FileNotFoundError, NotADirectoryError):
                return []
        return [path.rstrip("/").rpartition("/")[2] for path in found]

    def exists(self) -> bool:
        with _as_os_errors():
            return bool(self._fs.exists(self._root))

    def total_bytes(self) -> int:
        return sum(self.sizes().values())

    def sizes(self) -> dict[str, int]:
        """Return the keys of all parts, with their sizes in bytes."""
        with _as_os_errors():
            found = self._fs.find(self._root, detail=True)
        start = len(self._root.rstrip("/")) + 1
        return {path[start:]: int(facts["size"]) for path, facts in found.items()}

    def beside(self, name: str) -> RemoteSource:
        return RemoteSource(f"{self.url.rpartition('/')[0]}/{name}")

    def zarr_store(self) -> Store:
        from zarr.storage import FsspecStore

        return FsspecStore.from_url(self.url, storage_options=_options(self.url), read_only=True)

    def put(self, key: str, data: bytes) -> None:
        """Replace one part by ``data``, in one step in an object store and on a disk of this machine."""
        if self.path is not None:
            # fsspec would write in place: after a kill, half a file would have the final name.
            put_bytes(self.path / key, data)
            return
        with _as_os_errors():
            self._fs.pipe_file(self._path(key), data)

    def put_file(self, key: str, file: Path) -> None:
        """Replace one part by the bytes of a local file, as `put` does."""
        if self.path is not None:
            put_copy(self.path / key, file)
            return
        with _as_os_errors():
            self._fs.put_file(str(file), self._path(key))

    def prove(self) -> None:
        """Test whether the store can be written, with a small file that stays: `PROOF`.

        Raises PermissionError or FileNotFoundError (no such bucket) if the store refuses, and OSError if it
        cannot be reached.
        """
        if self.has_directories:
            self.make_directory_of(PROOF)
        self.put(PROOF, b"acquire copies recordings to this place\n")

    def make_directory_of(self, key: str) -> None:
        """Create the directory for a part, as a file system requires; an object store does not."""
        with _as_os_errors():
            self._fs.makedirs(self._path(key).rpartition("/")[0], exist_ok=True)

    @property
    def path(self) -> Path | None:
        """Its path, if it is on a disk of this machine."""
        return Path(self._root) if self.url.partition("://")[0] in ("file", "local") else None

    @property
    def has_directories(self) -> bool:
        """Whether directories exist without files in them, as on a file system."""
        return self.url.partition("://")[0] not in OBJECT_STORES

    def _path(self, key: str) -> str:
        return f"{self._root}/{key}"


def check_url(url: str) -> None:
    """Raise UsageError for an invalid URL, or if its packages are not installed. Connects to nothing."""
    if importlib.util.find_spec("fsspec") is None:
        raise UsageError(f"{url}: fsspec is not installed", hint="pip install 'tdi-acquire[remote]'")
    import fsspec

    protocol = url.partition("://")[0]
    _register(protocol)
    with _url_errors(url):
        fsspec.get_filesystem_class(protocol)


def _check_credentials(url: str) -> None:
    """Raise PlaceError for an object store without credentials in the environment. Connects to nothing."""
    protocol = url.partition("://")[0]
    family = _FAMILIES.get(protocol, protocol)
    if family not in WAYS_IN or not _has_obstore():
        return
    known = {name.upper() for name, value in os.environ.items() if value}
    if any(known.issuperset(way) for way in WAYS_IN[family]):
        return
    if family == "gs" and (home() / _GOOGLE_FILE).is_file():
        return
    usual, *others = (" and ".join(way) for way in WAYS_IN[family])
    raise PlaceError(
        f"{url} cannot be reached: the environment holds no credentials for {family}:// stores",
        possible=f"{usual}; or one of {', '.join(others)}",
        hint=f"export {usual.replace(' and ', '=… ')}=…",
    )


@contextmanager
def _url_errors(url: str) -> Iterator[None]:
    """Turn fsspec's errors about a URL into UsageError."""
    try:
        yield
    except (ValueError, ImportError) as error:
        if not is_url(url):
            raise UsageError(
                f"{url} is not a URL",
                possible="file:///DIRECTORY, s3://BUCKET/…",
                hint=Path(url).absolute().as_uri(),
            ) from error
        raise UsageError(
            f"{url} cannot be opened: {error}",
            possible=f"{', '.join(OBJECT_STORES)}, file, memory and others for which fsspec has a package",
            hint="pip install 'tdi-acquire[remote]'",
        ) from error
    except Exception as error:  # every file system has errors of its own
        raise StoreError(
            f"{url} cannot be opened: {_words(error)}", hint="check the network and the address"
        ) from error


def _options(url: str) -> dict[str, Any]:
    protocol = url.partition("://")[0]
    return {"retry_config": RETRY} if protocol in OBJECT_STORES and _has_obstore() else {}


@cache
def _register(protocol: str) -> None:
    """Have fsspec use obstore for object stores: it is faster, and has no event loop of its own."""
    if protocol in OBJECT_STORES and _has_obstore():
        from obstore.fsspec import register

        register(protocol)


@cache
def _has_obstore() -> bool:
    return importlib.util.find_spec("obstore") is not None


@contextmanager
def _as_os_errors() -> Iterator[None]:
    """Turn the exceptions of obstore, and of all other file systems, into OSError."""
    try:
        yield
    except OSError:
        raise
    except tuple(_store_errors()) as error:
        text = _ATTEMPTS.sub("", str(error).partition("\n")[0].partition(": <?xml")[0])
        kind = next(kind for known, kind in _store_errors().items() if isinstance(error, known))
        # obstore's exception gives most reasons, but that of a listing only the HTTP status.
        status = _STATUS.search(text)
        if status is not None:
            kind = _STATUS_ERRORS.get(status[1], kind)
        raise kind(text[:300]) from error
    # Those of ftplib, aiohttp and others have no base class in common.
    except Exception as error:
        status_code = getattr(error, "status", None)  # of HTTP
        raise _STATUS_ERRORS.get(str(status_code), OSError)(_words(error)) from error


def _words(error: Exception) -> str:
    """Return an error of a library in one line: some of them say nothing."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return shortened(str(error).partition("\n")[0], 300) or type(error).__name__


@cache
def _store_errors() -> dict[type[Exception], type[OSError]]:
    """Return obstore's exceptions, the most specific first, each with its OSError class."""
    if not _has_obstore():
        return {}
    from obstore.exceptions import BaseError, NotFoundError, PermissionDeniedError, UnauthenticatedError

    return {
        NotFoundError: FileNotFoundError,
        PermissionDeniedError: PermissionError,
        UnauthenticatedError: PermissionError,
        BaseError: OSError,
    }
