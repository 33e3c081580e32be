"""Small MJCF arms of our own, with what makes a file hard to read."""

from __future__ import annotations

from pathlib import Path

# Degrees and another Euler sequence, defaults by class, a frame, an arm that is turned and moved,
# an off-centre joint with ref, a slide, a full inertia tensor, two fingers, sites, a free box, a
# mesh that is not there, a keyframe; joint5 has no name.
ARM = """\
<?xml version="1.0"?>
<mujoco model="test arm">
  <!-- a comment that stays -->
  <compiler angle="degree" eulerseq="zyx" meshdir="nowhere"/>
  <option timestep="0.001"/>
  <default>
    <joint damping="3" frictionloss="2" limited="true" range="-160 160"/>
    <default class="wrist"><joint axis="0 1 0" range="-120 120"/></default>
  </default>
  <asset><mesh name="hull" file="hull.stl"/></asset>
  <worldbody>
    <body name="box" pos="2 0 1"><freejoint/><geom size="0.1"/></body>
    <body name="foot" pos="0.2 -0.1 0.3" euler="30 0 0">
      <inertial pos="0 0 0" mass="9" diaginertia="1 1 1"/>
      <geom type="mesh" mesh="hull"/>
      <body name="l1" pos="0 0 0.35" euler="20 10 -5">
        <inertial pos="0.01 0 0.1" mass="8" diaginertia="0.1 0.1 0.05"/>
        <joint name="a1" axis="0 0 1" pos="0.02 0.01 0" ref="15"/>
        <geom type="mesh" mesh="hull"/>
        <frame pos="0.1 0 0.1" axisangle="1 0 0 90">
          <body name="l2" pos="0 0 0.05" zaxis="0 1 0.2">
            <inertial pos="0.2 0 0" mass="6" diaginertia="0.1 0.2 0.2"/>
            <joint name="a2" axis="0 1 0"/>
            <body name="l3" pos="0.45 0 0" xyaxes="1 0 0.1 0 1 0">
              <inertial pos="0.1 0 0" mass="4" diaginertia="0.1 0.1 0.1"/>
              <joint name="a3" type="slide" axis="1 0 0" range="0 0.3"/>
              <body name="l4" pos="0.4 0 0" childclass="wrist" axisangle="0 0 1 40">
                <inertial pos="0 0 0.05" mass="2" fullinertia="0.02 0.02 0.02 0 0.001 0"/>
                <joint name="a4"/>
                <body name="l5" pos="0 0 0.2" quat="0.9 0.1 0 0.2">
                  <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
                  <joint axis="1 0 0"/>
                  <body name="hand" pos="0 0 0.1" euler="0 0 45">
                    <inertial pos="0 0 0.02" mass="0.5" diaginertia="0.01 0.01 0.01"/>
                    <site name="reflector" pos="0.05 0 0.02"/>
                    <site name="attachment_site" pos="0 0 0.08" euler="0 90 0"/>
                    <body name="left" pos="0 0.02 0.1">
                      <inertial pos="0 0 0" mass="0.1" diaginertia="0.001 0.001 0.001"/>
                      <joint name="f1" type="slide" axis="0 1 0" range="0 0.04"/>
                    </body>
                    <body name="right" pos="0 -0.02 0.1">
                      <inertial pos="0 0 0" mass="0.1" diaginertia="0.001 0.001 0.001"/>
                      <joint name="f2" type="slide" axis="0 -1 0" range="0 0.04"/>
                    </body>
                  </body>
                </body>
              </body>
            </body>
          </body>
        </frame>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="f1" joint2="f2"/></equality>
  <actuator><position name="drive2" joint="a2" kp="500"/></actuator>
  <sensor><jointpos joint="a1"/></sensor>
  <keyframe><key name="home" qpos="2 0 1 1 0 0 0  0.1 0.2 0.1 0.3 0.4 0 0"/></keyframe>
</mujoco>
"""
# MuJoCo reads it by itself too: without the mesh.
LOADABLE = ARM.replace('<geom type="mesh" mesh="hull"/>', "").replace(
    '<asset><mesh name="hull" file="hull.stl"/></asset>', ""
)


def write_arm(folder: Path, text: str = ARM) -> Path:
    """arm.xml in `folder`."""
    path = folder / "arm.xml"
    path.write_text(text, encoding="utf-8")
    return path
