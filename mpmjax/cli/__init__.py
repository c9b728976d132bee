"""Scene files and the shell's commands."""

from mpmjax.cli._commands import (
    chart_scene as chart_scene,
    check_scene as check_scene,
    describe_run as describe_run,
    fit_scene as fit_scene,
    installation as installation,
    run_scene as run_scene,
    study_scene as study_scene,
)
from mpmjax.cli._scene_file import load_scene as load_scene
from mpmjax.cli._scene_schema import scene_schema as scene_schema
from mpmjax.cli._scene_writer import save_scene as save_scene
