"""How long torch's threads spin before they sleep. Imported before torch, whose OpenMP library reads it when it loads.

GNU's default, 300,000 rounds, is for threads that have a core each. With other work beside, those that spin keep the
ones they wait for from running: on two busy cores a view took 10.6 s instead of 6.4 s, the demo 300 s instead of 80 s.
On idle cores 20,000 rounds cost nothing that could be measured, 2,000 a tenth.
"""

import os

os.environ.setdefault("GOMP_SPINCOUNT", "20000")
