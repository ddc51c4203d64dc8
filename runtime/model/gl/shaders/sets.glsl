// Sum two quantities of all ray sets at a panel's pixel. The second one is signed.
#for SETS
uniform sampler2D first@, second@;
uniform mat3 rays_from@;
#end
uniform vec2 rays;
uniform bool grey;  // the panel has one value for all channels: the mean of their sums

vec4 first_sum = vec4(0.0), second_sum = vec4(0.0);

void add(mat3 rays_from, sampler2D first, sampler2D second) {
    vec2 at = place(rays_from);
    if (!inside(at, rays, -EDGE_CLAMP_PX)) return;
    first_sum += sampled(first, at, rays);
    second_sum += signed_number(sampled(second, at, rays));
}

void gather() {
#for SETS
    add(rays_from@, first@, second@);
#end
    if (grey) {
        first_sum = vec4(dot(first_sum.rgb, vec3(1.0 / 3.0)));
        second_sum = vec4(dot(second_sum.rgb, vec3(1.0 / 3.0)));
    }
}
