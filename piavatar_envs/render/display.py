"""Off-screen OpenGL: whether there is any, where it may be used, and how to have VTK use it quietly on Linux."""

from __future__ import annotations

import contextlib
import ctypes
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import lru_cache

_WINDOW_VARIABLE = "VTK_DEFAULT_OPENGL_WINDOW"
_EGL_PLATFORM_DEVICE = 0x313F
_EGL_OPENGL_API = 0x30A2
#: Opens a window as VTK does by itself.
_PROBE = """
import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderWindow
window = vtkRenderWindow()
window.SetOffScreenRendering(True)
window.SetSize(16, 16)
window.Render()
"""
#: The process that opened the first window; None before.
_owner: int | None = None


def claim_opengl() -> None:
    """Note that this process opens windows."""
    global _owner
    _owner = _owner or os.getpid()


def owns_opengl() -> bool:
    """Return whether a window may be used here: in the main thread of a process that was not forked after the first.

    OpenGL's context belongs to a thread, and a forked process waits for ever for threads that it did not inherit.
    """
    return _owner in (None, os.getpid()) and threading.current_thread() is threading.main_thread()


@lru_cache(maxsize=1)
def opengl_available() -> bool:
    """Return whether VTK can open an off-screen window, because without OpenGL it kills the process.

    Elsewhere than on Linux the system brings OpenGL. With ``VTK_DEFAULT_OPENGL_WINDOW`` another process tries it.
    """
    if not sys.platform.startswith("linux"):
        return True
    if _WINDOW_VARIABLE in os.environ:
        return subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, timeout=60.0).returncode == 0
    try:
        return _egl_starts(ctypes.CDLL("libEGL.so.1"))
    except (OSError, AttributeError):  # no library, or one without these functions
        return False


@contextlib.contextmanager
def off_screen_window() -> Iterator[None]:
    """Let VTK open an EGL window at once on Linux, without its warning that there is no X server."""
    if not sys.platform.startswith("linux") or _WINDOW_VARIABLE in os.environ:
        yield
        return
    os.environ[_WINDOW_VARIABLE] = "vtkEGLRenderWindow"
    try:
        yield
    finally:
        del os.environ[_WINDOW_VARIABLE]


def _egl_starts(egl: ctypes.CDLL) -> bool:
    """Return whether EGL starts on its first device, or else on its default display, in VTK's order."""
    pointer, integer = ctypes.c_void_p, ctypes.c_int
    egl.eglGetProcAddress.restype, egl.eglGetProcAddress.argtypes = pointer, [ctypes.c_char_p]
    egl.eglGetDisplay.restype, egl.eglGetDisplay.argtypes = pointer, [pointer]
    egl.eglInitialize.argtypes = [pointer, ctypes.POINTER(integer), ctypes.POINTER(integer)]
    egl.eglTerminate.argtypes = [pointer]
    displays = []
    query = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    platform = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if query and platform:
        device, count = pointer(), integer(0)
        prototype = ctypes.CFUNCTYPE(ctypes.c_uint, integer, ctypes.POINTER(pointer), ctypes.POINTER(integer))
        if prototype(query)(1, ctypes.byref(device), ctypes.byref(count)) and count.value:
            prototype = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)
            displays.append(prototype(platform)(_EGL_PLATFORM_DEVICE, device, None))
    displays.append(egl.eglGetDisplay(None))
    for display in displays:
        if display and egl.eglInitialize(display, ctypes.byref(integer()), ctypes.byref(integer())):
            starts = bool(egl.eglBindAPI(_EGL_OPENGL_API))
            egl.eglTerminate(display)
            return starts
    return False
