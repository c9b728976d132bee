"""Runs, scenes and tables in files."""

from mpmjax.io._frame_writer import FIELDS_WRITTEN as FIELDS_WRITTEN, check_fields as check_fields
from mpmjax.io._run_file import check_hdf5 as check_hdf5, check_place as check_place, standing_in as standing_in
from mpmjax.io._runs import load as load, record as record, save as save, table as table
from mpmjax.io._schema import (
    MADE as MADE,
    are_registered as are_registered,
    arguments as arguments,
    classes_for as classes_for,
    decode as decode,
    encode as encode,
    evident_kinds as evident_kinds,
    forms_of as forms_of,
    is_open as is_open,
    known_classes as known_classes,
    parameters_of as parameters_of,
    register as register,
    words_of as words_of,
)
from mpmjax.io._transactional_file import (
    ReplacedFile as ReplacedFile,
    end_on_signals as end_on_signals,
    reason as reason,
    replacing as replacing,
    reporting as reporting,
    save_figure as save_figure,
    stopping as stopping,
)
