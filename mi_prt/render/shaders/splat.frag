#version 330 core

in vec2 at_place;
in float at_distance;
flat in vec3 at_viewer;
flat in vec3 at_normal;
flat in vec3 at_irradiance;

uniform vec4 eye;
uniform sampler2D surface;  // what is seen: rgb: unit normal, a: distance in front of the viewer

out vec4 weighted;  // rgb: weight times irradiance, a: weight

void main()
{
    // From where the ray meets the splat's plane, on to where it meets the surface. gl_FragCoord.w is the inverse of the
    // distance, or 1 for parallel rays.
    vec4 seen = texelFetch(surface, ivec2(gl_FragCoord.xy), 0);
    vec3 place = vec3(at_place, 0.0);
    vec3 offset = place + (at_viewer - eye.w * place) * ((at_distance - seen.a) * gl_FragCoord.w);
    offset.z *= FLATNESS;
    float d2 = dot(offset, offset);
    float alike = max(dot(seen.rgb, at_normal), 0.0);
    alike *= alike;
    alike *= alike;
    float weight = d2 < 1.0 ? alike * alike * exp(-0.5 * SHARPNESS * SHARPNESS * d2) : 0.0;
    weighted = vec4(weight * at_irradiance, weight);
}
