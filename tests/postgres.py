"""A PostgreSQL server of its own for the tests, in a folder that goes with it.

PostgreSQL refuses to run as root; then another user of the machine runs it.
"""

import os
import pwd
import shutil
import subprocess
import tempfile
from contextlib import contextmanager
from pathlib import Path

USERS = ("postgres", "nobody")  # who runs it in place of root


def find_programs():
    """The folder with initdb and pg_ctl; None, if there is no PostgreSQL on this machine."""
    places = sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    found = shutil.which("pg_ctl")
    places += [Path(found).parent] if found else []
    return next((p for p in places if (p / "initdb").exists() and (p / "pg_ctl").exists()), None)


@contextmanager
def running(programs):
    """Run a server, reached by a socket in its folder alone; yield that folder."""
    folder = tempfile.mkdtemp(prefix="pg")  # short: the path of a socket has a limit
    user = _user()
    if user is not None:
        shutil.chown(folder, user)

    def call(*args):
        subprocess.run(args, check=True, capture_output=True, user=user, cwd=folder, timeout=120)

    data = f"{folder}/data"
    settings = f"-c listen_addresses='' -c fsync=off -k {folder}"
    try:
        call(programs / "initdb", "-D", data, "-A", "trust", "-U", "study", "-E", "UTF8", "-N")
        call(programs / "pg_ctl", "-D", data, "-w", "-l", f"{folder}/log", "-o", settings, "start")
        yield folder
    finally:
        stop = [programs / "pg_ctl", "-D", data, "-m", "immediate", "stop"]
        subprocess.run(stop, capture_output=True, user=user, cwd=folder, check=False)
        shutil.rmtree(folder, ignore_errors=True)


def _user():
    if os.geteuid() != 0:
        return None
    known = {entry.pw_name for entry in pwd.getpwall()}
    return next(user for user in USERS if user in known)
