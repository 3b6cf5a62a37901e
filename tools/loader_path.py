"""Put this environment's ROS libraries on the loader's path and start Python again, same process.

`tools/setup_env.py` copies this module into the environment, where a .pth file imports it at every
start, so that nodes and messages are found without sourcing anything. The ROS wheels bring a start
of their own; it is forestalled because it fails when LD_LIBRARY_PATH was stripped or belongs to
another environment, and because it puts the folders into a random order.
"""

import os
import sys
from glob import glob

WHEELS_GUARD = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
OUR_GUARD = "_DOPSLAM_LOADER_PATH_PID"


def library_folders() -> list[str]:
    """List the folders of this environment which hold shared libraries of ROS."""
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    lib = os.path.join(sys.prefix, "lib")
    return [lib, *sorted(glob(os.path.join(lib, version, "site-packages", "ros_*.libs")))]


def restart_with_library_path() -> None:
    """Restart unless all folders are on the path already; what is on it stays in front."""
    present = [part for part in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep) if part]
    missing = [folder for folder in library_folders() if folder not in present]
    os.environ[WHEELS_GUARD] = "1"
    # The process keeps its number over exec: a loader that drops the path cannot make us loop.
    if not missing or os.environ.get(OUR_GUARD) == str(os.getpid()):
        return
    os.environ["LD_LIBRARY_PATH"] = os.pathsep.join(present + missing)
    os.environ[OUR_GUARD] = str(os.getpid())
    os.execv(sys.executable, sys.orig_argv)


restart_with_library_path()
