#!/usr/bin/env python3
"""Run a command and print its exit code, CPU seconds, wall seconds and memory in MB: usage.py COMMAND [ARGUMENT ...]

CPU seconds are user + system of the command and its children: this process has no other. The end of what the command
wrote to stderr comes out on stderr.
"""
import resource
import subprocess
import sys
import time

started = time.time()
done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(done.returncode, used.ru_utime + used.ru_stime, time.time() - started, used.ru_maxrss / 1024)
sys.stderr.buffer.write(done.stderr[-300:])
