"""Archives of runs, which the tests unpack."""

import tarfile


def unpack(archive, folder):
    """Unpack an archive, without files outside the folder where Python can refuse them (from 3.11.4 on)."""
    with tarfile.open(archive) as packed:
        packed.extraction_filter = getattr(tarfile, "data_filter", None)
        packed.extractall(folder)
    return folder
