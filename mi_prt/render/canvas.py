"""A float32 OpenGL image by way of pyrender, drawn with this program's own shaders.

Importing this module opens OpenGL.
"""

from functools import cache
from pathlib import Path

import numpy as np

from ..errors import RuntimeSetupError, SettingsError
from ..system.opengl import pyrender as load_pyrender
from ..system.opengl import raster_install_command, raster_platform

pyrender = load_pyrender()  # chooses the OpenGL platform, before OpenGL is imported
from OpenGL import GL
from pyrender.renderer import Renderer
from pyrender.shader_program import ShaderProgramCache

SHADERS = Path(__file__).parent / "shaders"


class _Canvas(Renderer):
    """pyrender's renderer with the shaders of this program and one float32 image, (h, w, 4),
    without multisampling.
    """

    def __init__(self, width, height):
        super().__init__(width, height)
        self._program_cache = ShaderProgramCache(str(SHADERS))

    def _bind_lighting(self, scene, program, node, flags):
        view = scene.main_camera_node.camera.view
        program.set_uniform("eye", view.eye)
        program.set_uniform("depth", view.depth)

    def _configure_main_framebuffer(self):
        if self._main_fb_ms is None:  # pyrender's name for the framebuffer that it draws to
            self._main_fb_ms, self._buffers = GL.glGenFramebuffers(1), GL.glGenRenderbuffers(2)
            GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._main_fb_ms)
            self._attach(self._buffers[0], GL.GL_RGBA32F, GL.GL_COLOR_ATTACHMENT0)
            self._attach(self._buffers[1], GL.GL_DEPTH_COMPONENT32F, GL.GL_DEPTH_ATTACHMENT)

    def _attach(self, buffer, pixels, place):
        GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
        GL.glRenderbufferStorage(
            GL.GL_RENDERBUFFER, pixels, self.viewport_width, self.viewport_height
        )
        GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, place, GL.GL_RENDERBUFFER, buffer)

    def _delete_main_framebuffer(self):
        if self._main_fb_ms is not None:
            GL.glDeleteFramebuffers(1, [self._main_fb_ms])
            GL.glDeleteRenderbuffers(2, self._buffers)
            self._main_fb_ms = None

    def _read_main_framebuffer(self, scene, flags):
        width, height = self.viewport_width, self.viewport_height
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb_ms)
        return GL.glReadPixels(0, 0, width, height, GL.GL_RGBA, GL.GL_FLOAT).reshape(
            height, width, 4
        )[::-1]


class _Camera(pyrender.Camera):
    def __init__(self, view):
        super().__init__()
        self.view = view

    def get_projection_matrix(self, width=None, height=None):
        return self.view.to_clip


class _Albedo(pyrender.Texture):
    """A texture in half precision, linear; pyrender's own have 8 bits, too few for dark albedo."""

    def __init__(self, texels):
        clamp = pyrender.GLTF.CLAMP_TO_EDGE
        sampler = pyrender.Sampler(None, GL.GL_LINEAR, GL.GL_LINEAR_MIPMAP_LINEAR, clamp, clamp)
        super().__init__(
            sampler=sampler, source_channels="RGB", width=texels.shape[1], height=texels.shape[0]
        )
        self._texels = texels

    def _add_to_context(self):
        super()._add_to_context()
        self._bind()
        texels = self._texels.astype(np.float32)
        GL.glTexImage2D(
            GL.GL_TEXTURE_2D,
            0,
            GL.GL_RGB16F,
            self.width,
            self.height,
            0,
            GL.GL_RGB,
            GL.GL_FLOAT,
            texels,
        )
        GL.glGenerateMipmap(GL.GL_TEXTURE_2D)
        self._unbind()


def new_primitive(part, points, albedo):
    """A part as pyrender draws it; its light is set later."""
    texture = None if part.texture is None else _Albedo(part.texture)
    return pyrender.Primitive(
        points.positions[part.points],
        normals=points.normals[part.points],
        tangents=albedo[part.points],
        texcoord_0=part.uv,
        indices=part.triangles,
        material=pyrender.MetallicRoughnessMaterial(baseColorTexture=texture, doubleSided=True),
    )


def drawing(primitives, view):
    """pyrender's scene of some primitives, over nothing."""
    drawing = pyrender.Scene(bg_color=np.zeros(4))
    drawing.add(pyrender.Mesh(primitives))
    drawing.add(_Camera(view))
    return drawing


@cache
def _context():
    """OpenGL's context: one for the process, because EGL ends all when it closes one."""
    platform = raster_platform()
    try:
        return pyrender.OffscreenRenderer(1, 1)
    except Exception as error:  # each platform raises errors of its own kind
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RuntimeSetupError(
            f"OpenGL cannot be opened through {platform} ({reason}); install what is missing with "
            f"`{raster_install_command()}`"
        ) from error


def make_current():
    """Make OpenGL calls of this thread go to the process's context."""
    _context()._platform.make_current()


def open_canvas(width, height):
    """A canvas of a size in samples, to be closed by its `delete`.

    Raises
    ------
    RuntimeSetupError
        If OpenGL cannot be opened.
    SettingsError
        If the size is above OpenGL's limit.
    """
    check_size(width, height)
    return _Canvas(width, height)


def check_size(width, height):
    """Raise SettingsError if an image of a size in samples is above OpenGL's limit; what it raises
    else, see `open_canvas`.
    """
    make_current()
    limit = min(
        GL.glGetIntegerv(GL.GL_MAX_RENDERBUFFER_SIZE), GL.glGetIntegerv(GL.GL_MAX_TEXTURE_SIZE)
    )
    if max(width, height) > limit:
        raise SettingsError(
            f"a raster image of {width}x{height} samples is above OpenGL's limit of {limit} a side:"
            " make it smaller"
        )


def draw(canvas, drawn):
    """The canvas (h, w, 4) float32 after drawing a pyrender scene: see the shaders for what the
    channels hold.
    """
    return canvas.render(drawn, pyrender.RenderFlags.OFFSCREEN)
