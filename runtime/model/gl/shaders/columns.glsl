// `runtime.model.chain.ColumnLaw` of the network's raster.
uniform float bend, middle;

float homography_from_column(float u) {
    return bend == 0.0 ? u : middle + (1.0 - exp(-bend * (u - middle))) / bend;
}

float column_from_homography(float t) {
    return bend == 0.0 ? t : middle - log(max(1.0 - bend * (t - middle), 1e-9)) / bend;
}
