"""Shows a field of your own in the browser, traced live, and turns it there.

    python examples/11_in_the_browser.py

Needs `pip install 'distrace[view]'`. A script waits for Ctrl-C with `wait=True`; a notebook goes on.
"""

import sys

import distrace as dt
from distrace.fields.primitives import box, difference, sphere

# %%
dice = difference(box([0.5, 0.5, 0.5]), sphere(0.65))
viewer = dt.view(dice, wait=False)
print(f"{viewer.address} shows a box without a ball")

# %%
if sys.stdin.isatty():
    input("Enter ends it ")
viewer.close()
