"""The commands by name: where each is, and what it is for in a few words. Imports nothing that takes time.

`acquire --help` is made of this table, and only the module of the command that is asked for is imported. A
new command is added here; a test compares the table with what the modules register.
"""

from __future__ import annotations

from dataclasses import dataclass

BEGIN, CAPTURE, RECORDINGS, SIMULATION, RIG = "Begin here", "Capture", "Recordings", "Simulation", "Rig"


@dataclass(frozen=True, slots=True)
class Listed:
    """A command, or a group of them, of the module ``acquire.cli.<module>``, which has ``register(app)``."""

    name: str
    module: str
    panel: str
    summary: str


COMMANDS = (
    Listed("demo", "demo", BEGIN, "record a scene with a simulated rig, reconstruct it, write a report"),
    Listed("serve", "serve", CAPTURE, "run the service that owns the rig's devices"),
    Listed("web", "web", CAPTURE, "serve the operator's page, or print its address"),
    Listed("arm", "control", CAPTURE, "start trigger and cameras; nothing is written yet"),
    Listed("start", "control", CAPTURE, "record, from now or from the past seconds on"),
    Listed("mark", "control", CAPTURE, "note in the recording that something happens now"),
    Listed("stop", "control", CAPTURE, "end the recording and seal it"),
    Listed("disarm", "control", CAPTURE, "stop trigger and cameras, or clear a fault"),
    Listed("status", "control", CAPTURE, "what the service is doing, and how well"),
    Listed("reload", "control", CAPTURE, "have the service read its rig file anew"),
    Listed("bench", "bench", CAPTURE, "search for the highest line rate without a loss"),
    Listed("ls", "recordings", RECORDINGS, "list the recordings of a directory"),
    Listed("info", "recordings", RECORDINGS, "what a recording holds, and how it ended"),
    Listed("verify", "recordings", RECORDINGS, "read all of a recording: is every line intact?"),
    Listed("recover", "recordings", RECORDINGS, "seal a recording whose writer was killed"),
    Listed("hold", "recordings", RECORDINGS, "keep lines of an endless recording"),
    Listed("upload", "recordings", RECORDINGS, "copy a recording to a remote store, also while it grows"),
    Listed("cut", "recordings", RECORDINGS, "write a stretch of both arms to a NumPy file"),
    Listed("reconstruct", "reconstruct", RECORDINGS, "make a video of a stretch, with voxels chosen now"),
    Listed("diagnose", "diagnose", RECORDINGS, "are the lines what the recording says they are?"),
    Listed("render", "render", RECORDINGS, "make a movie, an animation, stills or a page of videos"),
    Listed("export", "export", RECORDINGS, "write a video or lines for other programs"),
    Listed("import", "import_lines", RECORDINGS, "make a recording of another program's lines"),
    Listed("simulate", "simulate", SIMULATION, "record a simulated scene without a service"),
    Listed("paper", "paper", SIMULATION, "reproduce the paper's figures"),
    Listed("tradeoff", "tradeoff", SIMULATION, "draw accuracy against time for solvers and voxels"),
    Listed("replay", "replay", SIMULATION, "feed a recording through simulated devices again"),
    Listed("config", "config", RIG, "list, check and show configurations"),
    Listed("devices", "devices", RIG, "find triggers and cameras, and what each lacks"),
    Listed("doctor", "doctor", RIG, "is this host fit to capture, and what should be done?"),
    Listed("plugins", "plugins", RIG, "list the variants of effects, drivers, solvers and codecs"),
    Listed("completion", "completion", RIG, "let Tab complete commands in bash, zsh or fish"),
    Listed("install-service", "install_service", RIG, "print or install the systemd unit"),
    Listed("trigger", "trigger", RIG, "talk to the trigger"),
    Listed("camera", "camera", RIG, "look at the cameras"),
    Listed("calibrate", "calibrate", RIG, "measure what the instrument is"),
)

MODULES = tuple(dict.fromkeys(command.module for command in COMMANDS))
BY_NAME = {command.name: command for command in COMMANDS}
