"""A backend that behaves as the file name of its job's video says. Standard library only.

`succeed.mp4` finishes, `hang.mp4` never speaks again, and so on: each branch of main() is one behaviour.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

RESULT = {
    "format_version": 1,
    "particles": "particles.h5",
    "cameras": "cameras.json",
    "vdb_folder": "vdb",
    "num_frames": 3,
    "num_forecast": 0,
    "frame_start": 0,
    "fps": 24.0,
    "voxel_size": 0.1,
    "has_color": False,
    "smoke_color": [0.8, 0.8, 0.8],
    "bounds": [[-1.0, -1.0, 0.0], [1.0, 1.0, 2.0]],
    "buoyancy": [0.0, 0.0, 1.0],
}


DECISIONS = {
    "format_version": 1,
    "decisions": [
        {
            "name": "depth",
            "value": "silhouette",
            "reason": "The camera stands still.",
            "measured": {"turn_degrees": 0.0},
            "sets": {"volume.as_deep_as_wide": True},
            "keys": ["volume.as_deep_as_wide"],
            "is_overridden": False,
        }
    ],
    "warnings": [{"code": "camera_moves", "message": "The camera moves."}],
    "fingerprint": "abc",
}
ESTIMATE = {
    "format_version": 1,
    "seconds": 120.0,
    "stages": {"frames": 20.0, "visual": 100.0},
    "memory_gib": 0.5,
    "compile_seconds": 0.0,
    "quality": [{"view": "input", "mean_db": 32.0, "spread_db": 2.0, "num_scenes": 5}],
    "fingerprint": "abc",
}

_SENDING = threading.Lock()  # two threads send; print() would write a line and its end apart


def send(event: str, **values: object) -> None:
    with _SENDING:
        sys.stdout.write(json.dumps({"event": event, **values}) + "\n")
        sys.stdout.flush()


def start_time() -> str | None:
    try:
        return Path(f"/proc/{os.getpid()}/stat").read_text().rpartition(")")[2].split()[19]
    except OSError:
        return None


def watch(folder: Path) -> None:
    """Stops at a cancel, and when the parent is gone."""
    for line in sys.stdin:
        if json.loads(line).get("command") == "cancel":
            (folder / "running.json").unlink(missing_ok=True)
            send("cancelled", stage="visual")
            os._exit(0)
    os._exit(0)


def steps(count: int, seconds: float) -> None:
    send("stage", name="frames", index=0, count=2, skipped=True)
    send("stage", name="visual", index=1, count=2, skipped=False)
    for step in range(count):
        time.sleep(seconds)
        left = (count - step - 1) * seconds
        times = {"seconds_left": left, "job_seconds_left": left + 1.0}
        send("progress", stage="visual", step=step + 1, total=count, **times, metrics={"loss": 0.5})


def finish(folder: Path) -> None:
    (folder / "result.json").write_text(json.dumps(RESULT))
    send("done", result="result.json", seconds=1.0)


def inspect(behaviour: str) -> None:
    """What `inspect --json` prints."""
    if behaviour == "hang":
        time.sleep(600)
    if behaviour == "error":
        print("The clip is too short. Trim less of it.", file=sys.stderr)
        sys.exit(2)
    if behaviour == "noise":
        print('{"decisions": [], "estimates": 3}')
        return
    estimates = [{"preset": preset, **ESTIMATE} for preset in ("draft", "preview", "final")]
    print(json.dumps({**DECISIONS, "estimates": estimates}))


def main() -> None:
    if sys.argv[1] == "inspect":
        inspect(Path(sys.argv[2]).stem)
        return
    folder = Path(sys.argv[sys.argv.index("--job") + 1])
    job = json.loads((folder / "job.json").read_text())
    behaviour = Path(job["video"]).stem
    (folder / "running.json").write_text(json.dumps({"pid": os.getpid(), "start": start_time()}))
    if behaviour not in ("deaf", "deaf_group"):
        threading.Thread(target=watch, args=(folder,), daemon=True).start()
    if behaviour == "old_protocol":
        send("hello", protocol=99, version="9.9", device="cpu")
        time.sleep(60)
    if behaviour == "noise":
        print("Downloading weights... 100%")
        print("\x00\xff binary \x1b[31m", flush=True)
    send("hello", protocol=1, version="0.1.0", device="cpu")
    print("a line for the log", file=sys.stderr, flush=True)
    if behaviour == "succeed":
        (folder / "decisions.json").write_text(json.dumps(DECISIONS))
        send("artifact", kind="decisions", path="decisions.json")
        steps(3, 0.02)
        send("warning", code="camera_still", message="The camera is taken as still.")
        finish(folder)
    elif behaviour == "slow":
        steps(600, 0.1)
        finish(folder)
    elif behaviour == "error":
        steps(1, 0.0)
        send("error", code="clip_too_short", message="12 frames; 24 are needed.", hint="Trim less of the clip.", stage="frames")
        sys.exit(2)
    elif behaviour in ("hang", "deaf"):
        time.sleep(600)
    elif behaviour == "deaf_group":
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
        (folder / "grandchild.txt").write_text(str(child.pid))
        time.sleep(600)
    elif behaviour == "noise":
        print('{"event": "progress", "stage": "visual", "step": NaN, "total": 3}')
        print('{"event": "progress", "stage": "visual", "step": 1, "total": 3, "seconds_left": Infinity}')
        print('["not", "an", "event"]')
        print("x" * 3_000_000, flush=True)
        finish(folder)
    elif behaviour == "half_line":
        steps(1, 0.0)
        print("Traceback: the reason stands here", file=sys.stderr, flush=True)
        sys.stdout.write('{"event": "progress", "stage": "vis')
        sys.stdout.flush()
        os._exit(139)
    elif behaviour == "flood":
        send("stage", name="visual", index=0, count=1, skipped=False)
        for step in range(30_000):
            print(f'{{"event": "progress", "stage": "visual", "step": {step}, "total": 30000}}')
        finish(folder)
    elif behaviour == "endless_flood":
        while True:
            print('{"event": "progress", "stage": "visual", "step": 1, "total": 2}')
    elif behaviour == "lingers":
        finish(folder)
        time.sleep(600)
    elif behaviour == "after_last":
        finish(folder)
        send("error", code="late", message="Too late.", hint="None.")
    elif behaviour == "closes_output":
        sys.stdout.close()
        os.close(1)
        time.sleep(600)
    elif behaviour == "leaves_grandchild":
        child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])  # holds the pipe open
        (folder / "grandchild.txt").write_text(str(child.pid))
        finish(folder)
    (folder / "running.json").unlink(missing_ok=True)


if __name__ == "__main__":
    main()
