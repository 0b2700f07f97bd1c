#version 330 core

in vec3 at_position;
in vec3 at_normal;
in vec4 at_albedo;  // a: 1 where triangles of its own show the other side; plus 2 where triangles stand for a curve
in vec2 at_uv;
in vec4 at_light;   // rgb: weight times irradiance over pi, a: weight

uniform vec4 eye;    // position of the viewer; for parallel rays the direction to it, with w = 0
uniform vec4 depth;  // dot product with a position: 0 at the near plane, 1 at the far plane

#ifdef HAS_BASE_COLOR_TEX
struct Material { sampler2D base_color_texture; };
uniform Material material;
#endif

out vec4 radiance;  // a: covered

void main()
{
    vec3 albedo = at_albedo.rgb;
#ifdef HAS_BASE_COLOR_TEX
    albedo = texture(material.base_color_texture, at_uv, -0.5).rgb;  // sharper: each pixel has several samples
#endif
    // As in Mitsuba, the shading normal tells the side. On the triangles in place of a curved shape it would look away
    // along outlines, where that of the shape itself never does: there the triangle's own normal tells.
    vec3 toward = eye.xyz - eye.w * at_position;
    vec3 flat_normal = cross(dFdx(at_position), dFdy(at_position));
    vec3 seen_from = at_albedo.a > 1.5 ? flat_normal * sign(dot(flat_normal, toward)) : toward;
    bool behind = dot(at_normal, seen_from) < 0.0;
    if (behind && mod(at_albedo.a + 0.5, 2.0) > 1.0)
        discard;
    radiance = vec4(behind ? vec3(0.0) : albedo * at_light.rgb / at_light.a, 1.0);
    // Linear in distance: the usual depth leaves few digits to what is far away from a near plane of 1 cm.
    gl_FragDepth = dot(depth, vec4(at_position, 1.0));
}
