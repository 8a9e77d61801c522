"""Sets how long torch's threads spin before they sleep. Import it before torch: OpenMP reads the value as it loads.

GNU's default, 300,000 rounds, suits threads that have a core each. On busy cores, spinning threads block the ones they
wait for: a view took 10.6 s instead of 6.4 s on two cores, the demo 300 s instead of 80 s. On idle cores 20,000 rounds
cost nothing measurable; 2,000 cost 10 %.
"""

import os

os.environ.setdefault("GOMP_SPINCOUNT", "20000")
