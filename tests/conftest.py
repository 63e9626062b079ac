import signal

import hypothesis
import pytest
from drawn_aams import make_drawn_aam
from pairs import make_two_persons
from worlds import make_postures, make_world

from mmmgpu.backends import BACKENDS, get_backend

hypothesis.settings.register_profile("busy", deadline=None)  # timing is not what is tested
hypothesis.settings.load_profile("busy")


def pytest_configure(config):
    """Let Ctrl-C work where the shell has started us with it ignored, as behind an `&`."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser):
    parser.addoption("--backend", action="append", help="a backend to test; default: all of them")


def pytest_generate_tests(metafunc):
    if "backend" in metafunc.fixturenames:
        chosen = metafunc.config.getoption("--backend") or sorted(set(BACKENDS) - {"numpy"})
        metafunc.parametrize("backend", chosen, indirect=True, scope="session")


@pytest.fixture(scope="session")
def backend(request):
    """The name of a backend other than the reference.

    One that was asked for and cannot load is a failure, never a skip.
    """
    get_backend(request.param)
    return request.param


@pytest.fixture(scope="session")
def world(tmp_path_factory):
    """A drawn person in a few short clips with sound and alignments; see `worlds`."""
    return make_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="session")
def two_persons(world, tmp_path_factory):
    """The person of `world` with a model, and another one with two clips; see `pairs`."""
    return make_two_persons(world, tmp_path_factory.mktemp("second"))


@pytest.fixture(scope="session")
def drawn(world):
    """The person of `world` with landmarks and an appearance model; see `drawn_aams`."""
    return make_drawn_aam(world)


@pytest.fixture(scope="session")
def face_and_basis():
    """A performer and a small basis of mouth postures; see `worlds`."""
    return make_postures()


@pytest.fixture(scope="session")
def basis(face_and_basis):
    """A small basis of mouth postures of a performer."""
    return face_and_basis[1]
