"""Print the command of README.md that follows the comment ``<!-- command: NAME -->``."""

import re
import sys
from pathlib import Path

readme = Path(__file__).resolve().parents[1].joinpath("README.md").read_text()
found = re.search(rf"<!-- command: {re.escape(sys.argv[1])} -->\s*```[a-z]*\n(.*?)```", readme, re.DOTALL)
if not found:
    sys.exit(f"README.md has no command {sys.argv[1]!r}")
print(found.group(1))
