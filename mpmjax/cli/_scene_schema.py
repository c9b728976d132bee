"""The JSON schema of scene files, by which editors complete and check them."""

from typing import Any

from mpmjax.cli._fit_file import fit_parameter, fit_settings
from mpmjax.cli._measurements import KINDS, keys_of
from mpmjax.cli._scene_file import RunSettings, particles_in
from mpmjax.fitting import AbstractOptimiser
from mpmjax.io import class_schemas, save, table_schema
from mpmjax.state import Scene, fill


def scene_schema() -> dict[str, Any]:
    """The JSON schema of scene files."""

    def tables(each: dict[str, Any]) -> dict[str, Any]:
        return {"type": "array", "items": each}

    particles = table_schema(fill, without=("grid", "dtype"))
    particles["properties"]["material"] = {"type": ["integer", "string"]}
    run = table_schema(RunSettings)
    run["properties"]["method"]["anyOf"].append({"const": "auto"})
    fit, text = table_schema(fit_settings), {"type": "string"}
    fit["properties"] |= {
        "t1": {"type": "number"},
        "report": {"type": "object", "additionalProperties": text},
        "parameter": tables(table_schema(fit_parameter, without=("experiments",))),
        "observation": tables({"anyOf": [table_schema(keys_of(kind)[0], kind=kind) for kind in KINDS]}),
        "experiment": tables({"type": "object", "properties": {"scene": text}, "required": ["scene"]}),
    }
    schema = table_schema(Scene)
    schema["properties"] |= {
        "particles": {"anyOf": [particles, tables(particles), table_schema(particles_in)]},
        "run": run,
        "output": table_schema(save, without=("path", "run")),
        "fit": fit,
    }
    schema["required"] += ["particles", "run"]
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$defs": class_schemas(AbstractOptimiser),
    } | schema
