"""A float32 OpenGL image of splats, added up by weight on a surface that is known at each sample.

Importing this module opens OpenGL.
"""

import numpy as np

from .canvas import GL, SHADERS, ShaderProgramCache, make_current  # pyright: ignore[reportAttributeAccessIssue]


class SplatCanvas:
    """A float32 image, (h, w, 3), of splats on a surface that is known at each sample: see the
    shaders.

    Parameters
    ----------
    view : View
    samples : int
        Along each side of a pixel.
    surface : (H, W, 4) float32
        At each sample the unit normal, and the distance along the view's axis.
    reflected : (H, W, 3) float32
        Radiance per irradiance.
    depth : (H, W) float32
        In the view's window: fragments from there on are spared the shader.
    splats : (m, 7) float32
        Centre, radius, unit normal.
    constants : dict
        What stands for the names in capitals in the shader.
    """

    def __init__(self, view, samples, surface, reflected, depth, splats, constants):
        make_current()
        self._size, self._samples, self._count = view.size, samples, len(splats)
        cache = ShaderProgramCache(str(SHADERS))
        self._splat = _program(
            cache, "splat", constants, P=view.to_clip, eye=view.eye, axis=view.axis, surface=0
        )
        self._mean = _program(cache, "splat_mean", {}, weighted=0, reflected=1, samples=samples)
        width, height = (samples * side for side in self._size)
        self._surface = _texture(GL.GL_RGBA32F, width, height, GL.GL_RGBA, surface)
        self._reflected = _texture(GL.GL_RGB32F, width, height, GL.GL_RGB, reflected)
        self._depth = _texture(
            GL.GL_DEPTH_COMPONENT32F, width, height, GL.GL_DEPTH_COMPONENT, depth
        )
        self._weighted = _texture(GL.GL_RGBA32F, width, height, GL.GL_RGBA)
        self._radiance = _texture(GL.GL_RGBA32F, *self._size, GL.GL_RGBA)  # pyright: ignore[reportCallIssue]
        self._sums = _framebuffer(
            {GL.GL_COLOR_ATTACHMENT0: self._weighted, GL.GL_DEPTH_ATTACHMENT: self._depth}
        )
        self._image = _framebuffer({GL.GL_COLOR_ATTACHMENT0: self._radiance})
        self._vertices, (self._buffer, self._light) = GL.glGenVertexArrays(1), GL.glGenBuffers(2)
        GL.glBindVertexArray(self._vertices)
        _attributes(self._buffer, splats, {0: 4, 1: 3})
        _attributes(self._light, np.zeros((len(splats), 3), np.float32), {2: 3})
        GL.glBindVertexArray(0)

    def draw(self, irradiance):
        """Radiance (h, w, 3) float32 that reflects the irradiance (m, 3) float32 of the splats."""
        make_current()
        width, height = self._size
        GL.glBindBuffer(GL.GL_ARRAY_BUFFER, self._light)
        GL.glBufferData(GL.GL_ARRAY_BUFFER, irradiance.nbytes, irradiance, GL.GL_STREAM_DRAW)

        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._sums)
        GL.glViewport(0, 0, self._samples * width, self._samples * height)
        GL.glClearColor(0, 0, 0, 0)
        GL.glClear(GL.GL_COLOR_BUFFER_BIT)
        GL.glDisable(GL.GL_CULL_FACE)
        GL.glEnable(GL.GL_BLEND)
        GL.glBlendFunc(GL.GL_ONE, GL.GL_ONE)
        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glDepthFunc(GL.GL_LESS)
        GL.glDepthMask(GL.GL_FALSE)
        _bind_textures(self._surface)
        GL.glBindVertexArray(self._vertices)
        self._splat._bind()
        GL.glDrawArraysInstanced(GL.GL_TRIANGLE_STRIP, 0, 4, self._count)

        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._image)
        GL.glViewport(0, 0, width, height)
        GL.glDisable(GL.GL_BLEND)
        GL.glDisable(GL.GL_DEPTH_TEST)
        _bind_textures(self._weighted, self._reflected)
        self._mean._bind()
        GL.glDrawArrays(GL.GL_TRIANGLES, 0, 3)
        GL.glBindVertexArray(0)
        return GL.glReadPixels(0, 0, width, height, GL.GL_RGB, GL.GL_FLOAT).reshape(
            height, width, 3
        )[::-1]

    def delete(self):
        """Free what OpenGL holds."""
        make_current()
        self._splat.delete()
        self._mean.delete()
        GL.glDeleteFramebuffers(2, [self._sums, self._image])
        GL.glDeleteTextures(
            [self._surface, self._reflected, self._depth, self._weighted, self._radiance]
        )
        GL.glDeleteVertexArrays(1, [self._vertices])
        GL.glDeleteBuffers(2, [self._buffer, self._light])


def _program(cache, name, constants, **uniforms):
    program = cache.get_program(f"{name}.vert", f"{name}.frag", defines=constants)
    program._add_to_context()
    program._bind()
    for uniform, value in uniforms.items():
        program.set_uniform(uniform, value)
    return program


def _texture(kind, width, height, channels, texels=None):
    """A texture that is read by `texelFetch`; texels (h, w, …) float32 are given from the upper row
    down.
    """
    texture = GL.glGenTextures(1)
    GL.glBindTexture(GL.GL_TEXTURE_2D, texture)
    GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MIN_FILTER, GL.GL_NEAREST)
    data = None if texels is None else np.ascontiguousarray(texels[::-1])
    GL.glTexImage2D(GL.GL_TEXTURE_2D, 0, kind, width, height, 0, channels, GL.GL_FLOAT, data)
    GL.glBindTexture(GL.GL_TEXTURE_2D, 0)
    return texture


def _bind_textures(*textures):
    # unit 0 stays the active one, as pyrender has it
    for unit, texture in reversed(list(enumerate(textures))):
        GL.glActiveTexture(GL.GL_TEXTURE0 + unit)
        GL.glBindTexture(GL.GL_TEXTURE_2D, texture)


def _framebuffer(textures):
    framebuffer = GL.glGenFramebuffers(1)
    GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, framebuffer)
    for place, texture in textures.items():
        GL.glFramebufferTexture2D(GL.GL_FRAMEBUFFER, place, GL.GL_TEXTURE_2D, texture, 0)
    return framebuffer


def _attributes(buffer, values, widths):
    """Let columns of values (m, k) float32 be attributes of each instance: {location: how many
    columns}.
    """
    GL.glBindBuffer(GL.GL_ARRAY_BUFFER, buffer)
    GL.glBufferData(GL.GL_ARRAY_BUFFER, values.nbytes, values, GL.GL_STATIC_DRAW)
    first = 0
    for location, width in widths.items():
        GL.glEnableVertexAttribArray(location)
        GL.glVertexAttribPointer(
            location, width, GL.GL_FLOAT, GL.GL_FALSE, values.strides[0], GL.GLvoidp(first)
        )
        GL.glVertexAttribDivisor(location, 1)
        first += width * values.itemsize
