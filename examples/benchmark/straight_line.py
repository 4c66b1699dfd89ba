"""An entry to the benchmark as a program of its own: the straight line, on JSON lines.

    roboarm benchmark run --program "python straight_line.py" --quick --output entry

It could be written in any language, because it needs nothing but its standard input and output.
"""

import json
import sys

for line in sys.stdin:
    problem = json.loads(line)
    print(json.dumps({"path": [problem["start"], problem["goal"]]}), flush=True)
