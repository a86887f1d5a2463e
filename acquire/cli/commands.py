"""Table of the commands: name, module, group and a one-line summary. It imports nothing slow.

`acquire --help` is printed from this table, and only the module of the requested command is imported. A new
command must be added here; a test compares the table with the commands that the modules register.
"""

from __future__ import annotations

from dataclasses import dataclass

BEGIN, CAPTURE, RECORDINGS, SIMULATION, RIG = "Begin here", "Capture", "Recordings", "Simulation", "Rig"


@dataclass(frozen=True, slots=True)
class Listed:
    """A command or group of commands. Its module ``acquire.cli.<module>`` defines ``register(app)``."""

    name: str
    module: str
    panel: str
    summary: str


# Read from the modules themselves, help took 0.4 to 0.7 s of processor, most of it for imports of rich and
# pydantic.
COMMANDS = (
    Listed("demo", "demo", BEGIN, "record a scene with a simulated rig, reconstruct it and write a report"),
    Listed("serve", "serve", CAPTURE, "run the daemon that controls the rig's devices"),
    Listed("web", "web", CAPTURE, "serve the operator's page, or print its address"),
    Listed("arm", "control", CAPTURE, "start the trigger and the cameras without recording"),
    Listed("start", "control", CAPTURE, "start recording, from now or from a few seconds ago"),
    Listed("mark", "control", CAPTURE, "mark the current moment in the recording"),
    Listed("stop", "control", CAPTURE, "end the recording and seal it"),
    Listed("disarm", "control", CAPTURE, "stop the trigger and the cameras, or clear a fault"),
    Listed("status", "control", CAPTURE, "show what the daemon is doing, and how well"),
    Listed("reload", "control", CAPTURE, "make the daemon read its rig file again"),
    Listed("bench", "bench", CAPTURE, "find the highest line rate without lost lines"),
    Listed("ls", "recordings", RECORDINGS, "list the recordings in a directory"),
    Listed("info", "recordings", RECORDINGS, "show what a recording holds, and how it ended"),
    Listed("verify", "recordings", RECORDINGS, "read a whole recording and check every line"),
    Listed("recover", "recordings", RECORDINGS, "seal a recording whose writer was killed"),
    Listed("hold", "recordings", RECORDINGS, "keep lines of an endless recording from being dropped"),
    Listed("upload", "recordings", RECORDINGS, "copy a recording to a remote store, even while it grows"),
    Listed("cut", "recordings", RECORDINGS, "write a range of lines of both arms to a NumPy file"),
    Listed("reconstruct", "reconstruct", RECORDINGS, "make a video of a range of lines, with any voxels"),
    Listed("diagnose", "diagnose", RECORDINGS, "check the lines against the recording's own description"),
    Listed("render", "render", RECORDINGS, "turn videos into a movie, an animation, stills or a page"),
    Listed("export", "export", RECORDINGS, "write a video or lines for other programs"),
    Listed("import", "import_lines", RECORDINGS, "make a recording from another program's lines"),
    Listed("simulate", "simulate", SIMULATION, "record a simulated scene without a daemon"),
    Listed("paper", "paper", SIMULATION, "reproduce the paper's figures"),
    Listed("tradeoff", "tradeoff", SIMULATION, "plot accuracy against time for solvers and voxels"),
    Listed("replay", "replay", SIMULATION, "feed a recording through the simulated devices again"),
    Listed("config", "config", RIG, "list, check and show configurations"),
    Listed("devices", "devices", RIG, "list triggers and cameras, and any problem with them"),
    Listed("doctor", "doctor", RIG, "check whether this host is fit to capture"),
    Listed("plugins", "plugins", RIG, "list the installed effects, scenes, drivers, codecs and solvers"),
    Listed("completion", "completion", RIG, "print the script for Tab completion"),
    Listed("install-service", "install_service", RIG, "print or install the systemd unit"),
    Listed("trigger", "trigger", RIG, "operate the sync trigger directly"),
    Listed("camera", "camera", RIG, "inspect the cameras"),
    Listed("calibrate", "calibrate", RIG, "measure the properties of the instrument"),
)

MODULES = tuple(dict.fromkeys(command.module for command in COMMANDS))
BY_NAME = {command.name: command for command in COMMANDS}
