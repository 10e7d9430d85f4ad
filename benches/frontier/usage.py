#!/usr/bin/env python3
"""Run a command and print its exit code, CPU seconds, wall seconds and memory in MB: usage.py COMMAND [ARGUMENT ...]

CPU seconds are user + system of the command and its children: this process has no other. The last line that the command
wrote to stderr comes out on stderr. The command ends with whoever started this, and what it leaves in the folder for
temporary files is removed.
"""
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time


def end(process):
    """Ends the command and all that it has started."""
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        pass


def attend(process, parent):
    """Waits until the process that started this one is gone."""
    while os.getppid() == parent:
        time.sleep(0.2)
    end(process)


def main():
    parent = os.getppid()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        with open(os.path.join(folder, "stderr"), "w+b") as told:
            started = time.time()
            surroundings = os.environ | {"TMPDIR": folder}
            process = subprocess.Popen(
                sys.argv[1:], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=told, env=surroundings, start_new_session=True
            )
            threading.Thread(target=attend, args=(process, parent), daemon=True).start()
            try:
                code = process.wait()
            finally:
                end(process)
            wall = time.time() - started
            used = resource.getrusage(resource.RUSAGE_CHILDREN)
            told.seek(max(0, told.seek(0, 2) - 4000))
            lines = told.read().decode(errors="replace").split("\n")
    print(code, used.ru_utime + used.ru_stime, wall, used.ru_maxrss / 1024)
    print(next((line.strip()[-300:] for line in reversed(lines) if line.strip()), ""), file=sys.stderr)


if __name__ == "__main__":
    main()
