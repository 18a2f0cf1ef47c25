"""Each file of tests is collected where its library is, in the version that it is for."""

from importlib.metadata import PackageNotFoundError, version

LIBRARIES = {
    "test_gymnax.py": ("gymnax", "1."),
    "test_rejax.py": ("rejax", ""),
    "test_sb3.py": ("stable-baselines3", ""),
}


def is_there(package, prefix):
    """Whether a package is installed in such a version."""
    try:
        return version(package).startswith(prefix)
    except PackageNotFoundError:
        return False


collect_ignore = [file for file, library in LIBRARIES.items() if not is_there(*library)]
