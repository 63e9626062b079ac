import secrets
import signal

import hypothesis
import psycopg
import pytest
from drawn_aams import make_drawn_aam
from outside import missing, running_chromium
from pairs import make_two_persons
from postgres import find_programs, running
from studied import write_clips
from worlds import make_postures, make_world

from mmmgpu.adaptation import adapt
from mmmgpu.backends import BACKENDS, get_backend
from mmmgpu.model_files import load
from mmmgpu.processes import kept_processes
from mmmgpu.study_creation import StudyOptions, create_study
from mmmgpu.transferring import transfer

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
def family(backend):
    """The name of that backend without its device: a key of `BACKENDS`."""
    return backend.partition(":")[0]


@pytest.fixture(scope="module")
def kept():
    """The processes of one job do those that follow in the module, which start sooner."""
    with kept_processes():
        yield


@pytest.fixture(scope="session")
def world(tmp_path_factory):
    """A drawn person in a few short clips with sound and alignments; see `worlds`."""
    return make_world(tmp_path_factory.mktemp("world"))


@pytest.fixture(scope="session")
def two_persons(world, tmp_path_factory):
    """The person of `world` with a model, and another one with two clips; see `pairs`."""
    return make_two_persons(world, tmp_path_factory.mktemp("second"))


@pytest.fixture(scope="session")
def transferred(two_persons, tmp_path_factory):
    """The first one's model with the face of the second: its path, and the model."""
    out = tmp_path_factory.mktemp("transferred") / "second ü.mmm"
    given = two_persons.second.clips, two_persons.second.alignments, two_persons.points
    return out, transfer(load(two_persons.source), *given, out)


@pytest.fixture(scope="session")
def adapted(two_persons, transferred, tmp_path_factory):
    """That model in the style of the second: its path, and the model."""
    out = tmp_path_factory.mktemp("adapted") / "a.mmm"
    given = two_persons.second.clips, two_persons.second.alignments
    return out, adapt(transferred[1], *given, out)


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


@pytest.fixture(scope="session")
def study_folder(tmp_path_factory):
    """A study of four conditions, three sentences and 50 participants; not to be changed."""
    clips = write_clips(tmp_path_factory.mktemp("clips"))
    out = tmp_path_factory.mktemp("studies") / "lips.study"
    create_study(clips, out, options=StudyOptions(participants=50, seed=1))
    return out


@pytest.fixture(scope="module")
def chromium():
    """A real browser; see `outside`."""
    with running_chromium() as browser:
        yield browser


@pytest.fixture(scope="session")
def postgres_server():
    """The socket's folder of a running PostgreSQL.

    Without PostgreSQL its tests are skipped; where MMMGPU_REQUIRE_POSTGRES=1 that is a failure.
    """
    programs = find_programs()
    if programs is None:
        missing("no PostgreSQL on this machine", "MMMGPU_REQUIRE_POSTGRES")
    with running(programs) as folder:
        yield folder


@pytest.fixture
def postgres_url(postgres_server):
    """The URL of an empty PostgreSQL database."""
    name = f"study_{secrets.token_hex(4)}"
    place = f"host={postgres_server} user=study dbname=postgres"
    with psycopg.connect(place, autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    return f"postgresql://study@/{name}?host={postgres_server}"
