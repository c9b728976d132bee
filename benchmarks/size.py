"""How large is the package? Files, classes, functions, and what its lines are, room by room.

python benchmarks/size.py
"""

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path
from types import ModuleType

import mpmjax as mpm

ROOT = Path(__file__).parents[1]
DEFINITIONS = ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef
COLUMNS = "files", "classes", "functions", "lines", "docstrings", "blank", "imports", "comments", "statements"


def docstring_of(node: ast.AST) -> ast.Expr | None:
    """The statement that is the docstring of a module, class or function."""
    first = node.body[0] if isinstance(node, (ast.Module, *DEFINITIONS)) and node.body else None
    text = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str)
    return first if text else None


def counts_of(path: Path) -> Counter:
    """The columns of one file, and the lines of the bodies of its functions. Each line counts once: comments are lines
    of nothing else."""
    text = path.read_text(encoding="utf-8")
    lines, nodes = text.splitlines(), list(ast.walk(ast.parse(text)))

    def covered(statements: list) -> set[int]:
        return {line for node in statements if node for line in range(node.lineno, node.end_lineno + 1)}

    docstrings = covered([docstring_of(node) for node in nodes])
    imports = covered([node for node in nodes if isinstance(node, (ast.Import, ast.ImportFrom))])
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    comments = {t.start[0] for t in tokens if t.type == tokenize.COMMENT and t.line.lstrip().startswith("#")}
    blank = {number for number, line in enumerate(lines, 1) if not line.strip()} - docstrings
    functions = [node for node in nodes if isinstance(node, DEFINITIONS[:2])]
    bodies = [covered(node.body) - docstrings - blank for node in functions]
    counts = Counter(files=1, classes=sum(isinstance(node, ast.ClassDef) for node in nodes), functions=len(functions))
    counts |= Counter(lines=len(lines), docstrings=len(docstrings), imports=len(imports), comments=len(comments))
    rest = len(lines) - sum(map(len, (docstrings, imports, comments, blank)))
    return counts | Counter(blank=len(blank), statements=rest, bodies=sum(map(len, bodies)))


def main() -> None:
    rooms: dict[str, Counter] = {}
    for path in sorted((ROOT / "mpmjax").rglob("*.py")):
        room = path.relative_to(ROOT).parts[1] if path.parent.name != "mpmjax" else "(top)"
        rooms.setdefault(room, Counter()).update(counts_of(path))
    total = sum(rooms.values(), Counter())
    print(f"{'':16}" + "".join(f"{column:>11}" for column in COLUMNS))
    for room, counts in (rooms | {"all": total}).items():
        print(f"{room:16}" + "".join(f"{counts[column]:11}" for column in COLUMNS))
    pages = ROOT / "README.md", *(ROOT / "docs").glob("*.md")
    words = sum(len(page.read_text(encoding="utf-8").split()) for page in pages)
    names = [name for name in dir(mpm) if not name.startswith("_") and not isinstance(getattr(mpm, name), ModuleType)]
    mean = total["bodies"] / total["functions"]
    print(f"{mean:.1f} lines in the body of a function, {len(names)} public names at the top, {words} words of docs")


if __name__ == "__main__":
    main()
