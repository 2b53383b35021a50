"""Model files of unknown origin, read so that nothing in them is ever run."""

from safe_files.errors import UnsafeFileError
from safe_files.inspection import Report, inspect_model
from safe_files.models import load_model
from safe_files.normalization import load_vec_normalize
from safe_files.replay_buffers import load_replay_buffer

__all__ = [
    "Report",
    "UnsafeFileError",
    "inspect_model",
    "load_model",
    "load_replay_buffer",
    "load_vec_normalize",
]
