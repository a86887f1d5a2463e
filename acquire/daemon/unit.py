"""The daemon as a systemd service: readiness, watchdog, required and denied privileges."""

from __future__ import annotations

import grp
import math
import os
import pwd
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from acquire.daemon.host import needed_bytes
from acquire.place import default_socket, home

if TYPE_CHECKING:
    from acquire.config import RigConfig

WATCHDOG_S = 30
"""Time without a message from the daemon, which sends two a second, after which systemd restarts it."""
STOP_S = 60
"""Time to stop, in addition to that of sealing a recording (`recording.seal_timeout_s`)."""
PROCESSES_BYTES = 600_000_000
"""Memory of daemon, nursery, recorder, watcher, grabbers and page; 250 MB were measured (`pss`, 8 stages)."""
UNIT = "acquire.service"
SOCKET = "/run/acquire/acquire.sock"
"""Default socket of the host's service."""
RULES = "70-acquire.rules"

# Class ef, subclass 05 is the control interface of USB3 Vision; 1209 is the vendor of a trigger that is a USB
# device itself, 0403 (FTDI) that of the serial port on its board.
UDEV = """\
# The sync trigger and USB3 Vision cameras belong to the group `plugdev`: no root is needed to use them.
SUBSYSTEM=="usb", ENV{ID_USB_INTERFACES}=="*:ef0500:*", MODE="0660", GROUP="plugdev", TAG+="uaccess"
SUBSYSTEM=="usb", ATTR{idVendor}=="1209", MODE="0660", GROUP="plugdev", TAG+="uaccess"
SUBSYSTEM=="tty", ATTRS{idVendor}=="0403", MODE="0660", GROUP="plugdev", TAG+="uaccess"
"""


@dataclass(frozen=True, slots=True)
class UnitPlace:
    """Directory of the unit, and whether it is for one user or the host."""

    user: bool
    directory: Path

    @classmethod
    def of(cls, *, user: bool) -> UnitPlace:
        if user:
            configuration = os.environ.get("XDG_CONFIG_HOME") or home() / ".config"
            return cls(True, Path(configuration) / "systemd/user")
        return cls(False, Path("/etc/systemd/system"))


def unit_text(rig: RigConfig, config: Path, *, user: bool, account: str | None = None) -> str:
    """Return the unit for a rig file. ``account``: user of the host's service; None: the current one."""
    recordings = rig.recording.directory.absolute()
    stop_s = round(rig.recording.seal_timeout_s) + STOP_S
    python = _word(Path(sys.executable))
    command = f"{python} -m acquire serve --config {_word(config.absolute())}"
    who = account or _own_account()
    # Of this host's groups, those whose members may use ports and USB devices.
    here = {group.gr_name for group in grp.getgrall()}
    groups = " ".join(name for name in ("dialout", "plugdev") if name in here)
    socket = rig.control.socket
    # The default one is that of the service's environment.
    listens = "" if socket == default_socket() else f" --socket {_word(socket.absolute())}"
    service = [
        "Type=notify",
        "NotifyAccess=main",  # the watchdog listens to the daemon alone, not to what it has started
        f"ExecStart={command}",
        f"ExecReload={python} -m acquire reload{listens}",
        *([] if user else [f"User={who}"]),
        *([] if user or not groups else [f"SupplementaryGroups={groups}"]),
        *([] if user else _directories()),
        f"WorkingDirectory={_quoted(recordings)}",
        f"WatchdogSec={WATCHDOG_S}",
        "Restart=on-failure",
        "RestartSec=1",
        # SIGTERM goes to the daemon only: to the others it would be an order to end, and they have to
        # drain and seal the recording first.
        "KillMode=mixed",
        f"TimeoutStopSec={stop_s}",
        f"TimeoutStartSec={STOP_S}",
        *_memory(rig),
        "LimitNOFILE=65536",
        # For `stream.realtime`; LimitNICE below is for the recorder, which gets more time than others.
        "LimitRTPRIO=1",
        "LimitNICE=-15",
        *(_hardening(recordings, rig) if not user else ["NoNewPrivileges=yes", "UMask=0077"]),
    ]
    wanted = "default.target" if user else "multi-user.target"
    return "\n".join(
        [
            "[Unit]",
            f"Description=acquire, the capture service of rig {rig.name}",
            *([] if user else ["After=network.target time-sync.target"]),
            # systemd gives up after five starts in 10 s by default: with RestartSec=1, a disk that is mounted
            # a little late would find the service down for good.
            "StartLimitIntervalSec=60",
            "StartLimitBurst=10",
            "",
            "[Service]",
            *service,
            "",
            "[Install]",
            f"WantedBy={wanted}",
            "",
        ]
    )


def _own_account() -> str:
    """This user's name, or the number of one who is in no list of accounts: systemd takes both."""
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return str(os.geteuid())


def _directories() -> list[str]:
    return [
        "RuntimeDirectory=acquire",
        "RuntimeDirectoryMode=0700",
        # For compiled loops, which every job of the page would compile anew: home and package are read-only.
        "CacheDirectory=acquire",
        # The former is the directory of `SOCKET`, which is then the default socket of the daemon.
        "Environment=XDG_RUNTIME_DIR=/run/acquire NUMBA_CACHE_DIR=/var/cache/acquire",
    ]


def _hardening(recordings: Path, rig: RigConfig) -> list[str]:
    """Return settings that deny everything unneeded. (Not MemoryDenyWriteExecute: the simulator compiles.)"""
    writable = {recordings, rig.control.socket.absolute().parent}
    return [
        "# If memory runs out, other processes are killed before the capture. Only root may set this.",
        "OOMScoreAdjust=-500",
        "NoNewPrivileges=yes",
        "UMask=0077",
        "ProtectSystem=strict",
        f"ReadWritePaths={' '.join(f'-{_quoted(path)}' for path in sorted(writable))}",
        "ProtectHome=read-only",
        "ProtectKernelTunables=yes",
        "ProtectKernelModules=yes",
        "ProtectKernelLogs=yes",
        "ProtectControlGroups=yes",
        "ProtectClock=yes",
        "ProtectHostname=yes",
        "RestrictSUIDSGID=yes",
        "RestrictNamespaces=yes",
        "LockPersonality=yes",
        "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK AF_PACKET",
        "SystemCallArchitectures=native",
        "CapabilityBoundingSet=",
    ]


def _memory(rig: RigConfig) -> list[str]:
    """Return the settings for memory shortage, with comments for administrators who want to change them."""
    needed_mb = math.ceil((sum(needed_bytes(rig)) + PROCESSES_BYTES) / 1e6)
    return [
        "# A process that the kernel kills for lack of memory is replaced, and the capture continues.",
        "# The page's jobs are killed first, then page, recoveries, uploads. Restart= restarts the service.",
        "OOMPolicy=continue",
        "# Rings and processes keep their memory when other programs need some. MemoryMax= is not set: it",
        "# would have to include the memory of the videos that jobs of the page compute.",
        f"MemoryLow={needed_mb}M",
    ]


def _quoted(path: Path) -> str:
    """Quote a path for systemd, which separates words at spaces and expands %."""
    text = str(path).replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{text}"' if " " in text or '"' in text else text


def _word(path: Path) -> str:
    """Quote a path as a word of a command, in which systemd expands $ as well."""
    return _quoted(path).replace("$", "$$")
