"""Runs the recipes of docs/recipes.md as they are written.

    python scripts/peers/recipes.py path/to/isolume docs/recipes.md

Every `sh` and `python` block runs in order in one folder, but those behind a line `<!-- not run: why -->`, which are printed.
"""

import os
import pathlib
import re
import subprocess
import sys
import tempfile

program, page = (pathlib.Path(p).resolve() for p in sys.argv[1:3])
text = page.read_text()
environment = dict(os.environ, PATH=f"{program.parent}{os.pathsep}{os.environ['PATH']}", PYVISTA_OFF_SCREEN="true")
failed = 0
with tempfile.TemporaryDirectory() as folder:
    for block in re.finditer(r"(?:<!-- not run: (?P<why>[^>]*) -->\n)?```(?P<kind>sh|python)\n(?P<code>.*?)```", text, re.S):
        title = re.findall(r"^##? (.*)", text[: block.start()], re.M)[-1]
        if block["why"]:
            print(f"skip {title}: {block['why']}")
            continue
        command = ["sh", "-ec", block["code"]] if block["kind"] == "sh" else [sys.executable, "-c", block["code"]]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        failed += done.returncode != 0
        print(f"{'FAIL' if done.returncode else 'ok  '} {title} ({block['kind']}) {done.stdout.strip()[-200:]}", flush=True)
        if done.returncode:
            print(done.stderr.strip()[-2000:])
print(f"{failed} failed")
sys.exit(failed > 0)
