"""The reference scene's eight motions here and in MuJoCo, on one core in one run: simulated seconds per CPU second and
the error of the object's angle at the end of each hold.

    python -m venv .venv && .venv/bin/pip install mujoco numpy && .venv/bin/python benches/grasp_mujoco.py

MuJoCo gets the same planar pinch: two hinged links with spherical tips, a box that moves in the plane, two contacts with
friction 1, implicitfast at 1 ms, joints driven along the same quintics. Its contacts are rigid spheres with MuJoCo's own
softness, the nearest it has: it knows no tangential spring and no rolling dome, so its angles are those of another model.
Several contact settings are tried, and the one with the least
angle error counts. The loop runs in C (mujoco.rollout); Python only prepares.

With `--samples FILE` (a line a sample: seconds, degrees) only MuJoCo runs, and each case that keeps both contacts is a line:
time constant, cone, impratio, CPU seconds, the largest difference of the angle at any sample. `palpate chart --peers` carries
this file and calls it so.
"""

import re
import subprocess
import sys
import time

import mujoco
import numpy as np
from mujoco import rollout

STEP, REST, MOVE, HOLD = 1e-3, 0.5, 0.5, 1.0
MOTIONS = [(6, 6), (20, -10), (-2, 13), (-10, 20), (-7, 17), (17, -7), (-15, 25), (5, 5)]

SCENE = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" gravity="0 0 -9.81" cone="{cone}" impratio="{impratio}"/>
  <default><geom friction="1 0.005 0.0001" condim="3" solref="{solref} 1"/></default>
  <worldbody>
    <body name="finger1" pos="-0.0485 0 0">
      <joint name="t1" type="hinge" axis="0 -1 0"/>
      <inertial pos="0 0 -0.03" mass="0.1" diaginertia="0.00091 0.00091 0.00001"/>
      <geom name="tip1" type="sphere" pos="0 0 -0.06" size="0.02" contype="1" conaffinity="2"/>
    </body>
    <body name="finger2" pos="0.0485 0 0">
      <joint name="t2" type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 -0.03" mass="0.1" diaginertia="0.00091 0.00091 0.00001"/>
      <geom name="tip2" type="sphere" pos="0 0 -0.06" size="0.02" contype="1" conaffinity="2"/>
    </body>
    <body name="object" pos="0 0 -0.06">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <joint name="turn" type="hinge" axis="0 -1 0"/>
      <inertial pos="0 0 0" mass="0.1" diaginertia="6e-5 6e-5 6e-5"/>
      <geom name="box" type="box" size="0.03 0.03 0.03" contype="2" conaffinity="1"/>
    </body>
  </worldbody>
  <actuator>
    <position joint="t1" kp="2000" kv="3"/>
    <position joint="t2" kp="2000" kv="3"/>
  </actuator>
</mujoco>
"""

# Time constant of the contacts (s), friction cone, and its impedance against the normal's (more = less creep).
# 0.004 s gives about the soft tips' force at their displacements.
CONTACTS = [
    (time_constant, cone, impratio)
    for time_constant in (0.01, 0.005, 0.004, 0.003, 0.002)
    for cone, impratio in (("pyramidal", 1), ("elliptic", 1), ("elliptic", 10), ("elliptic", 100))
]


def control():
    """Desired joint angles (rad) at each step, and the steps at which a hold ends."""
    rows, ends, here = [np.zeros((round(REST / STEP), 2))], [round(REST / STEP)], np.zeros(2)
    for target in np.radians(MOTIONS):
        u = (np.arange(round(MOVE / STEP)) / round(MOVE / STEP))[:, None]
        rows += [here + (target - here) * u**3 * (10 - 15 * u + 6 * u**2), np.tile(target, (round(HOLD / STEP), 1))]
        ends.append(ends[-1] + round((MOVE + HOLD) / STEP))
        here = target
    return np.concatenate(rows), np.array(ends)


def mujoco_run(time_constant, cone, impratio, repeats=3):
    """Least CPU seconds, object angles (degrees) after each step, least number of contacts at the ends of the holds."""
    text = SCENE.format(step=STEP, solref=time_constant, cone=cone, impratio=impratio)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    ctrl, ends = control()
    start = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    best = np.inf
    for _ in range(repeats):
        before = time.process_time()
        states, _ = rollout.rollout(model, [data], start[None], ctrl[None])
        best = min(best, time.process_time() - before)
    # The first entry of a full physics state is the time, then positions: two joints, x, z, turn.
    contacts = []
    for end in ends:
        data.qpos[:] = states[0, end - 1, 1:6]
        mujoco.mj_forward(model, data)
        contacts.append(data.ncon)
    return best, np.degrees(states[0, :, 5]), min(contacts)


def against(samples):
    """Prints a line a case: settings, CPU seconds, largest angle error (degrees) over samples of time (s) and angle (degrees)."""
    steps = np.round(samples[:, 0] / STEP).astype(int)
    used = (steps > 0) & (steps <= len(control()[0]))
    for case in CONTACTS:
        seconds, angles, contacts = mujoco_run(*case)
        off = np.abs(angles[steps[used] - 1] - samples[used, 1]).max()
        if contacts == 2 and off < 90:
            print(*case, f"{seconds:.6f}", f"{off:.6f}")


def main():
    print(f"MuJoCo {mujoco.__version__}, implicitfast, {STEP} s\n")
    own = subprocess.run(["cargo", "bench", "--bench", "grasp"], capture_output=True, text=True, check=True).stdout
    print(own)
    wanted = np.array([float(v) for v in re.search(r"postures, degrees: (.*)", own).group(1).split()])
    row = re.search(r"rk4\s+minimal\s+\S+\s+(\S+)\s+(\S+)\s+(\S+)", own)
    rate, error = float(row.group(2)), float(row.group(3))

    duration = control()[1][-1] * STEP
    columns = ("time constant", "cone", "impratio", "contacts", "CPU s", "simulated s/s", "angle error, deg")
    print("  ".join(columns))
    held = []
    for case in CONTACTS:
        seconds, angles, contacts = mujoco_run(*case)
        off = np.abs(angles[control()[1] - 1] - wanted).max()
        shown = [*map(str, case), str(contacts), f"{seconds:.4f}", f"{duration / seconds:.0f}", f"{off:.2f}"]
        print("  ".join(v.rjust(len(c)) for v, c in zip(shown, columns)))
        # A dropped object costs nothing to simulate: only grasps that keep both contacts count.
        if contacts == 2 and off < 90:
            held.append((off, duration / seconds))
    if not held:
        print("\nMuJoCo dropped the object in every case")
        return
    best, fastest = min(held), max(h[1] for h in held)
    print(
        f"\nMuJoCo: {best[1]:.0f} simulated s/s at its least angle error of {best[0]:.2f} degrees; {fastest:.0f} at most"
        f"\nrk4, minimal form: {rate:.0f} simulated s/s at {error:.1e} degrees, {rate / best[1]:.1f} times as fast"
        f" ({rate / fastest:.1f} times the fastest)"
    )


if __name__ == "__main__":
    if len(sys.argv) == 3 and sys.argv[1] == "--samples":
        against(np.loadtxt(sys.argv[2], ndmin=2))
    else:
        main()
