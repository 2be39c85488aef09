"""Print the renderer of a headless OpenGL context created through EGL, or fail with the reason.

Runs with any python3 and without packages, because it decides whether GL packages must be
installed. It creates the context as MuJoCo does (libEGL, its devices, libGL), so its answer holds
for MuJoCo.
"""

import ctypes
import sys

EGL_PLATFORM_DEVICE_EXT = 0x313F
EGL_OPENGL_API = 0x30A2
EGL_SURFACE_TYPE = 0x3033
EGL_PBUFFER_BIT = 0x0001
EGL_RENDERABLE_TYPE = 0x3040
EGL_OPENGL_BIT = 0x0008
EGL_NONE = 0x3038
GL_RENDERER = 0x1F01


def load(names):
    """Load the first library of `names` that exists."""
    for name in names:
        try:
            return ctypes.CDLL(name, mode=ctypes.RTLD_GLOBAL)
        except OSError:
            continue
    sys.exit("cannot load " + " or ".join(names))


def extension(egl, name, result, *arguments):
    """Return an EGL extension function, or exit if the driver lacks it."""
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    address = egl.eglGetProcAddress(name)
    if not address:
        sys.exit("EGL lacks " + name.decode())
    return ctypes.CFUNCTYPE(result, *arguments)(address)


def displays(egl):
    """Yield the initialised display of each EGL device."""
    pointer = ctypes.c_void_p
    number = ctypes.c_int
    query = extension(egl, b"eglQueryDevicesEXT", ctypes.c_uint, number, pointer, pointer)
    get_display = extension(
        egl, b"eglGetPlatformDisplayEXT", pointer, ctypes.c_uint, pointer, pointer
    )
    devices = (pointer * 16)()
    count = number()
    query(16, devices, ctypes.byref(count))
    for device in devices[: count.value]:
        display = get_display(EGL_PLATFORM_DEVICE_EXT, device, None)
        if display and egl.eglInitialize(pointer(display), None, None):
            yield pointer(display)


def renderer(egl, gl, display):
    """Return the GL renderer string of a context on `display`, or None if none can be created."""
    pointer = ctypes.c_void_p
    number = ctypes.c_int
    wanted = (EGL_SURFACE_TYPE, EGL_PBUFFER_BIT, EGL_RENDERABLE_TYPE, EGL_OPENGL_BIT, EGL_NONE)
    config = pointer()
    count = number()
    egl.eglBindAPI(EGL_OPENGL_API)
    egl.eglChooseConfig(
        display, (number * len(wanted))(*wanted), ctypes.byref(config), 1, ctypes.byref(count)
    )
    if not count.value:
        return None
    egl.eglCreateContext.restype = pointer
    context = egl.eglCreateContext(display, config, None, None)
    if not context or not egl.eglMakeCurrent(display, None, None, pointer(context)):
        return None
    gl.glGetString.restype = ctypes.c_char_p
    name = gl.glGetString(GL_RENDERER)
    egl.eglMakeCurrent(display, None, None, None)
    egl.eglTerminate(display)
    return name and name.decode(errors="replace")


def main():
    """Print the first renderer found."""
    egl = load(["libEGL.so.1"])
    gl = load(["libOpenGL.so.0", "libGL.so.1"])
    for display in displays(egl):
        name = renderer(egl, gl, display)
        if name:
            print(name)
            return
    sys.exit("no EGL device gives an OpenGL context")


if __name__ == "__main__":
    main()
