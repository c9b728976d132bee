"""Runs, scenes and tables in files."""

from mpmjax.io._atomic_write import (
    reason as reason,
    replacing as replacing,
    save_figure as save_figure,
)
from mpmjax.io._hdf5 import check_hdf5 as check_hdf5, check_place as check_place
from mpmjax.io._interrupt import end_on_signals as end_on_signals, reporting as reporting, stopping as stopping
from mpmjax.io._record import record as record
from mpmjax.io._runs import load as load, save as save, steps_in as steps_in
from mpmjax.io._schema import arguments as arguments, decode as decode, register as register
from mpmjax.io._transactional_file import ReplacedFile as ReplacedFile
