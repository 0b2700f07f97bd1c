#version 330 core

uniform sampler2D weighted;   // rgb: weights times irradiance, a: weights, summed over splats
uniform sampler2D reflected;  // rgb: radiance per irradiance
uniform int samples;          // along each side of a pixel

out vec4 radiance;

void main()
{
    radiance = vec4(0.0);
    for (int i = 0; i < samples * samples; i++) {
        ivec2 place = ivec2(gl_FragCoord.xy) * samples + ivec2(i % samples, i / samples);
        vec4 sum = texelFetch(weighted, place, 0);
        if (sum.a > 0.0)
            radiance.rgb += texelFetch(reflected, place, 0).rgb * sum.rgb / sum.a;
    }
    radiance /= float(samples * samples);
}
