"""Shows a policy at work, to watch and to drive: in a browser, or in MuJoCo's own window.

`Session` steps an env at the pace of the clock and takes requests; a display (`browser`, `native`) shows it.
"""

from ksim_rl.viewer.session import Conditions, Session
