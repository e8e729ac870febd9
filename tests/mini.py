"""A small scene with a glint slot for tests of the harness, and the harness itself in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

import support

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"

MINI_SCENE = """<scene version="3.0.0">
    <default name="tiles" value="2"/>
    <default name="folder" value="maps"/>
    <default name="normalmap" value="$folder/flakes.exr"/>
    <default name="alpha" value="0.1"/>
    <bsdf type="normalmap" id="metal">
        <texture name="normalmap" type="bitmap">
            <string name="filename" value="$normalmap"/>
            <boolean name="raw" value="true"/>
            <string name="filter_type" value="nearest"/>
            <transform name="to_uv"><scale x="$tiles" y="$tiles" z="1"/></transform>
        </texture>
        <bsdf type="roughconductor">
            <string name="distribution" value="beckmann"/>
            <string name="material" value="none"/>
            <float name="alpha" value="$alpha"/>
            <rgb name="specular_reflectance" value="0.9, 0.8, 0.7"/>
        </bsdf>
    </bsdf>
    <shape type="rectangle"><ref id="metal"/></shape>
    <emitter type="constant"><float name="radiance" value="0.2"/></emitter>
    <emitter type="point">
        <point name="position" x="1" y="1" z="3"/>
        <float name="intensity" value="10"/>
    </emitter>
    <sensor type="perspective">
        <float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="0, -2, 3" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="64"/>
            <integer name="height" value="64"/>
            <string name="pixel_format" value="rgb"/>
            <rfilter type="box"/>
        </film>
    </sensor>
</scene>
"""


def write_scene(folder):
    """Write the scene, its map, and a scene without slot; returns the folder."""
    (folder / "maps").mkdir()
    normals = support.random_normals(16, 16, 0.2)
    support.write_exr(folder / "maps" / "flakes.exr", (normals + 1) / 2)
    (folder / "mini.xml").write_text(MINI_SCENE, encoding="utf-8")
    (folder / "plain.xml").write_text('<scene version="3.0.0"/>', encoding="utf-8")
    return folder


def no_assets():
    """For `scenes.find_scenes`: nothing is to be generated here."""
    raise AssertionError("nothing is to be generated here")


def command(folder, out, cache, *options):
    """The command line of `scripts/compare` without its set-up, and its environment."""
    line = [sys.executable, "-m", "glints_harness.cli", "--scene-dir", str(folder), "--res", "32"]
    line += ["--out", str(out), "--cache", str(cache), *options]
    return line, {**os.environ, "PYTHONPATH": str(SCRIPTS)}


def run_compare(*arguments):
    """Run `command(...)` to its end; returns what it printed."""
    line, environment = command(*arguments)
    return subprocess.run(line, env=environment, capture_output=True, text=True, check=False)
