"""Commands of the shell, run in this process."""

from typer.testing import CliRunner

from mpmjax_command import app


def shell(*words: object) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command."""
    result = CliRunner().invoke(app, [str(w) for w in words])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def refused(*words: object) -> str:
    """The one line that a refused command says."""
    code, _, err = shell(*words)
    lines = [line for line in err.splitlines() if line.startswith("mpmjax: ")]
    assert code == 2
    assert len(lines) == 1
    assert "Traceback" not in err
    return lines[0]
