#version 330 core

layout(location = 0) in vec4 splat;       // centre, radius
layout(location = 1) in vec3 normal;
layout(location = 2) in vec3 irradiance;  // at the centre

uniform mat4 P;     // world to clip space
uniform vec4 eye;   // position of the viewer; for parallel rays the direction to it, with w = 0
uniform vec4 axis;  // dot product with a position: distance in front of the viewer

// Lengths are in radii, in the frame of the splat: z along its normal.
out vec2 at_place;        // on the splat's plane, from its centre
out float at_distance;    // in front of the viewer, in metres
flat out vec3 at_viewer;  // as seen from the centre
flat out vec3 at_normal;  // in the world
flat out vec3 at_irradiance;

void main()
{
    vec3 u = normalize(cross(normal, abs(normal.x) < 0.7 ? vec3(1.0, 0.0, 0.0) : vec3(0.0, 1.0, 0.0)));
    mat3 frame = mat3(u, cross(normal, u), normal);
    at_place = vec2(gl_VertexID % 2, gl_VertexID / 2) * 2.0 - 1.0;  // a corner of the square around the disk
    vec4 position = vec4(splat.xyz + frame * vec3(splat.w * at_place, 0.0), 1.0);
    gl_Position = P * position;
    at_distance = dot(axis, position);
    at_viewer = (eye.xyz - eye.w * splat.xyz) * frame / splat.w;
    at_normal = normal;
    at_irradiance = irradiance;
}
