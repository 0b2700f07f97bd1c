#version 330 core

// Names in capitals are locations that pyrender fills in. Its tangents carry albedo here, its colours light.
layout(location = 0) in vec3 position;
layout(location = NORMAL_LOC) in vec3 normal;
layout(location = TANGENT_LOC) in vec4 albedo;
layout(location = TEXCOORD_0_LOC) in vec2 uv;
layout(location = COLOR_0_LOC) in vec4 light;

uniform mat4 P;  // world to clip space

out vec3 at_position;
out vec3 at_normal;
out vec4 at_albedo;
out vec2 at_uv;
out vec4 at_light;

void main()
{
    gl_Position = P * vec4(position, 1.0);
    at_position = position;
    at_normal = normal;
    at_albedo = albedo;
    at_uv = uv;
    at_light = light;
}
