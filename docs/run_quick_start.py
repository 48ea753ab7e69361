"""Run the quick start from the present folder: its commands, then its program, as `quick-start.md` has them."""

import os
import re
import subprocess
from pathlib import Path

DOCS = Path(__file__).resolve().parent
text = (DOCS / "quick-start.md").read_text()
program, commands = (
    re.search(rf"^```{language}\n(.*?)^```$", text[text.index(heading) :], re.DOTALL | re.MULTILINE)[1]
    for heading, language in (("## The same from Python", "python"), ("## The same from the command line", "sh"))
)
# The example's files, where the commands name them; the scene names its model as `make demo` leaves it.
for name in ("study.toml", "scene.toml"):
    path = Path("examples/demo") / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text((DOCS.parent / path).read_text().replace("../../demo/sheet.morph", "../../sheet.morph"))
for command in commands.replace("\\\n", " ").splitlines():
    print(f"$ {command}", flush=True)
    subprocess.run([os.environ.get("MORPH", "morph"), *command.split()[1:]], check=True)
Path("demo").mkdir(exist_ok=True)
for name in ("sheet.morph", "sequence"):
    if not (Path("demo") / name).exists():
        (Path("demo") / name).symlink_to(Path("..") / name)
exec(compile(program, "quick-start.md", "exec"), {})
