# SPDX-License-Identifier: Apache-2.0
"""A Python function over numpy views of XLA's CPU buffers, called from inside jit.

`jax.pure_callback` does the same, but copies, and keeps its program out of the persistent
compilation cache. This speaks XLA's C interface for foreign functions (`xla/ffi/api/c_api.h` in
jaxlib) through ctypes, so nothing needs a compiler. The program holds the target's name only.
"""

import ctypes
import traceback
from collections.abc import Callable

import jax
import numpy as np

API_MAJOR, API_MINOR = 0, 3
"""The version of the C interface that the structures below follow (XLA accepts older minors)."""

_METADATA = 1  # XLA_FFI_Extension_Metadata
_EXECUTE = 3  # XLA_FFI_ExecutionStage_EXECUTE
_INTERNAL = 13  # XLA_FFI_Error_Code_INTERNAL

_DTYPES = {1: np.dtype(bool), 4: np.dtype(np.int32), 11: np.dtype(np.float32)}  # XLA_FFI_DataType

_Kernel = Callable[[list[np.ndarray], list[np.ndarray]], None]


def _struct(name: str, *fields: tuple[str, type]) -> type[ctypes.Structure]:
    """Returns a ctypes structure; all of XLA's begin with their size and a list of extensions."""
    head = [("struct_size", ctypes.c_size_t), ("extension", ctypes.c_void_p)]
    return type(name, (ctypes.Structure,), {"_fields_": head + list(fields)})


_Version = _struct("Version", ("major", ctypes.c_int), ("minor", ctypes.c_int))
_ErrorArgs = _struct("ErrorArgs", ("message", ctypes.c_char_p), ("code", ctypes.c_int))
_CreateError = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArgs))
_Api = _struct(
    "Api",
    ("version", _Version),
    ("internal", ctypes.c_void_p),
    ("create_error", _CreateError),
)
_Buffer = _struct(
    "Buffer",
    ("dtype", ctypes.c_int),
    ("data", ctypes.c_void_p),
    ("rank", ctypes.c_int64),
    ("dims", ctypes.POINTER(ctypes.c_int64)),
)
_Buffers = _struct(  # the arguments and the results have the same layout
    "Buffers",
    ("size", ctypes.c_int64),
    ("types", ctypes.c_void_p),
    ("items", ctypes.POINTER(ctypes.POINTER(_Buffer))),
)
_CallFrame = _struct(
    "CallFrame",
    ("api", ctypes.POINTER(_Api)),
    ("context", ctypes.c_void_p),
    ("stage", ctypes.c_int),
    ("arguments", _Buffers),
    ("results", _Buffers),
)
_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_CallFrame))


class _Metadata(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("version", _Version),
        ("traits", ctypes.c_uint32),
    ]


class _Extension(ctypes.Structure):
    """The head of every extension, and the one field of the metadata extension."""

    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(_Metadata)),
    ]


def _views(buffers: ctypes.Structure) -> list[np.ndarray]:
    """Returns numpy views of XLA's buffers, without copying."""
    views = []
    for i in range(buffers.size):
        buffer = buffers.items[i].contents
        shape = buffer.dims[: buffer.rank]
        dtype = _DTYPES[buffer.dtype]
        nbytes = dtype.itemsize
        for length in shape:
            nbytes *= length
        memory = (ctypes.c_char * nbytes).from_address(buffer.data) if nbytes else b""
        views.append(np.frombuffer(memory, dtype).reshape(shape))
    return views


def _answer_metadata(frame: ctypes.Structure) -> bool:
    """Answers XLA's question for the handler's version, if this call is that question."""
    address = frame.extension
    while address:
        extension = _Extension.from_address(address)
        if extension.type == _METADATA:
            version = extension.metadata.contents.version
            version.major, version.minor = API_MAJOR, API_MINOR
            extension.metadata.contents.traits = 0
            return True
        address = extension.next
    return False


def _error(frame: ctypes.Structure, message: str) -> int | None:
    """Returns an XLA error object; XLA raises it in the caller's thread and frees it."""
    arguments = _ErrorArgs(ctypes.sizeof(_ErrorArgs), None, message.encode(), _INTERNAL)
    return frame.api.contents.create_error(ctypes.byref(arguments))


def _handler(kernel: _Kernel) -> Callable:
    def call(pointer) -> int | None:
        frame = pointer.contents
        try:
            if _answer_metadata(frame) or frame.stage != _EXECUTE:
                return None
            kernel(_views(frame.arguments), _views(frame.results))
            return None
        except BaseException:  # nothing may cross the C boundary: XLA reports it
            return _error(frame, traceback.format_exc())

    return call


_registered: dict[str, object] = {}  # XLA keeps the addresses, so the functions must live for ever


def register(name: str, kernel: _Kernel) -> bool:
    """Makes `kernel(inputs, outputs)` the CPU target `name`; returns false if XLA will not have it.

    The kernel fills the arrays of `outputs`; both lists hold views that are valid during the call.
    What it raises becomes a `jax.errors.JaxRuntimeError` in the program that called it. Arrays are
    float32, int32 or bool. Registering a name again changes nothing.
    """
    if name in _registered:
        return True
    function = _Handler(_handler(kernel))
    address = ctypes.cast(function, ctypes.c_void_p).value
    if not address:
        return False
    try:
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")
    except Exception:  # another major version of the interface: the caller has a slower way
        return False
    _registered[name] = function
    return True
