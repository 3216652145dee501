#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__) || defined(_M_FP_FAST)
#error "missing inputs are NaN, which -ffast-math, -ffinite-math-only and /fp:fast do away with: compile without them"
#endif
/* Nor with -fsingle-precision-constant, as firmware may be, or where a double has 32 bits: then this has no size. */
typedef char gpvo_needs_doubles[sizeof(1.0) == 2 * sizeof(1.0f) ? 1 : -1];

/* What the arithmetic below needs of a motion, and what it gives back. Tangent order: translation x y z [m], rotation
 * x y z [rad], in the rectified left optical frame. Matrices are row-major. */
typedef struct {
    double mean[6];        /* of the error: zero, as no mean that was tried gained anything */
    double covariance[36]; /* total, about the mean */
    double jitter[36];     /* the three parts it is the sum of */
    double white[36];
    double bias[36];             /* time constants of its axes: GPVO_BIAS_TAU_S, but for what the next one makes */
    double calibration_root[36]; /* L: of the bias, L L^T is what a wrong calibration makes; its columns change sign with
                                  * the motion, and last for GPVO_CALIBRATION_TAU_S */
    double epistemic[6]; /* share of each variance that comes from being away from the training data */
    double in_domain;    /* 0..1 */
    double confidence;   /* 0..1 */
    double nu;           /* degrees of freedom of the Student-t of that covariance; 0: Gaussian */
    double distance;     /* from the training domain, in training standard deviations */
} gpvo_estimate;

/* Whether a feature is there: not NaN, not infinite, not beyond all measure. */
static int gpvo_known(double v) { return fabs(v) < GPVO_LARGEST; }

static double gpvo_clip(double v, double low, double high) { return v < low ? low : v > high ? high : v; }

/* Draws the standardised features into the training domain; returns how far outside they were, given the variance of
 * the motion. */
static double gpvo_locate(const double *features, const double *base, double dt_s, double *inside) {
    double beyond = 0.0, joint = 0.0;
    int i, j;
    for (i = 0; i < GPVO_N_FEATURES; ++i) {
        double u = (features[i] - gpvo_centre[i]) / gpvo_scale[i];
        double noise = 0.0, dt2 = dt_s * dt_s, away;
        int missing = !gpvo_known(features[i]);
        for (j = 0; j < 6; ++j) {
            int at = j * GPVO_N_FEATURES + i;
            noise += base[j] * (gpvo_by_velocity[at] + gpvo_by_acceleration[at] / dt2) / dt2;
        }
        if (missing) {
            u = 0.0;
            beyond += gpvo_missing[i];
        }
        inside[i] = gpvo_clip(u, gpvo_low[i], gpvo_high_edge[i]);
        away = u - gpvo_clip(u, gpvo_least[i], gpvo_most[i]);
        beyond += away * away / (1.0 + noise / (gpvo_scale[i] * gpvo_scale[i]));
    }
    for (j = 0; j < GPVO_N_FEATURES; ++j) {
        double w = 0.0;
        for (i = 0; i < GPVO_N_FEATURES; ++i) w += inside[i] * gpvo_whitening[i * GPVO_N_FEATURES + j];
        joint += w * w;
    }
    joint = sqrt(joint) - GPVO_RADIUS;
    if (joint < 0.0) joint = 0.0;
    return sqrt(beyond + joint * joint);
}

/* Log of the variance over the base, and the variance of that log, from inputs (standardised features the GP sees). */
static void gpvo_log_ratio(const double *inputs, double ratio[6], double spread[6]) {
    double kernel[GPVO_N_POINTS];
    int i, j, r;
    for (j = 0; j < 6; ++j) {
        ratio[j] = gpvo_offset[j];
        spread[j] = gpvo_signal_var[j];
    }
    for (i = 0; i < GPVO_N_POINTS; ++i) {
        double e = 0.0;
        for (j = 0; j < GPVO_N_INPUTS; ++j) {
            double d = (inputs[j] - gpvo_gp_centre[j]) / gpvo_lengthscale[j] - gpvo_point[i * GPVO_N_INPUTS + j];
            e += d * d;
        }
        kernel[i] = exp(-0.5 * e);
        for (j = 0; j < 6; ++j) ratio[j] += gpvo_kernel_weight[j * GPVO_N_POINTS + i] * kernel[i];
    }
    for (r = 0; r < GPVO_N_DIRECTIONS; ++r) {
        double z = 0.0;
        for (i = 0; i < GPVO_N_POINTS; ++i) z += (double)gpvo_projection[r * GPVO_N_POINTS + i] * kernel[i];
        for (j = 0; j < 6; ++j) spread[j] -= (double)gpvo_reduction[j * GPVO_N_DIRECTIONS + r] * z * z;
    }
    for (j = 0; j < 6; ++j)
        if (spread[j] < 0.0) spread[j] = 0.0;
}

/* Variance that is known before anything is learnt: geometry, floor, parts that grow with the motion. */
static void gpvo_base(const double *features, double dt_s, double base[6], double plain[6]) {
    double column[GPVO_N_BASE], translation = 0.0, rotation = 0.0;
    int i, j;
    for (i = 0; i < GPVO_N_BASE; ++i) {
        int at = gpvo_base_column[i];
        double least = gpvo_centre[at] + gpvo_scale[at] * gpvo_low[at];
        column[i] = gpvo_known(features[at]) ? features[at] : gpvo_absent[i];
        if (i >= 6) column[i] = gpvo_clip(column[i], least, GPVO_LN_LARGEST);
    }
    for (i = 0; i < 3; ++i) {
        translation += column[i] * dt_s * column[i] * dt_s;
        rotation += column[3 + i] * dt_s * column[3 + i] * dt_s;
    }
    for (j = 0; j < 6; ++j) {
        const double *theta = gpvo_theta + 5 * j, *without = gpvo_theta_plain + 5 * j;
        double geometry = GPVO_N_BASE >= 12 ? exp(column[(6 + j) % GPVO_N_BASE]) : 0.0;
        double noise = GPVO_N_BASE > 12 ? exp(2.0 * column[12 % GPVO_N_BASE]) : 0.0;
        base[j] = (theta[0] + theta[4] * noise) * geometry + theta[1] + theta[2] * translation + theta[3] * rotation;
        plain[j] = (without[0] + without[4] * noise) * geometry + without[1] + without[2] * translation + without[3] * rotation;
        if (base[j] < GPVO_LEAST_VAR) base[j] = GPVO_LEAST_VAR;
        if (plain[j] < GPVO_LEAST_VAR) plain[j] = GPVO_LEAST_VAR;
    }
}

/* As wrong as a motion can be, translation and rotation: no more than VO's and the usual one are long. */
static void gpvo_limits(const double *features, double dt_s, double limit[2]) {
    int i;
    limit[0] = limit[1] = 0.0;
    for (i = 0; i < 6; ++i) {
        int at = gpvo_base_column[i];
        double rate = gpvo_known(features[at]) ? features[at] : gpvo_absent[i];
        limit[i / 3] += (rate * rate + gpvo_usual_rate_var[i]) * dt_s * dt_s;
    }
}

static double gpvo_within(double variance, double limit) {
    double ratio = variance / limit;
    if (ratio > 1e8) ratio = 1e8;
    variance = limit * ratio / sqrt(1.0 + ratio * ratio);
    return variance < GPVO_LEAST_VAR ? GPVO_LEAST_VAR : variance;
}

/* Log-determinant of a symmetric 6x6 matrix, NaN where it is not positive definite; by its Cholesky factor. */
static double gpvo_ln_det(const double C[36]) {
    double L[36], sum = 0.0;
    int i, j, k;
    for (i = 0; i < 6; ++i)
        for (j = 0; j <= i; ++j) {
            double v = C[i * 6 + j];
            for (k = 0; k < j; ++k) v -= L[i * 6 + k] * L[j * 6 + k];
            L[i * 6 + j] = i == j ? sqrt(v) : v / L[j * 7];
            if (i == j) sum += 2.0 * log(L[i * 7]);
        }
    return sum;
}

/* Correlations of jitter, white and bias; the first two mixed with those of the geometric covariance where there is one. */
static void gpvo_correlations(const double *geometry, double R[3][36]) {
    int i, j, p, known = geometry != 0 && GPVO_GEOMETRY_WEIGHT > 0.0;
    double own[36], ridge[36];
    for (i = 0; i < 6 && known; ++i)
        for (j = 0; j < 6; ++j) {
            double both = 0.5 * (geometry[i * 6 + j] + geometry[j * 6 + i]);
            own[i * 6 + j] = both / (sqrt(geometry[i * 7]) * sqrt(geometry[j * 7]));
            ridge[i * 6 + j] = own[i * 6 + j] + (i == j ? 1e-6 : 0.0);
        }
    if (known) known = isfinite(gpvo_ln_det(ridge));
    for (p = 0; p < 3; ++p)
        for (i = 0; i < 36; ++i) {
            R[p][i] = gpvo_correlation[36 * p + i];
            if (known && p < 2) R[p][i] = GPVO_GEOMETRY_WEIGHT * own[i] + (1.0 - GPVO_GEOMETRY_WEIGHT) * R[p][i];
            R[p][i] = R[p][i] * (1.0 - 1e-6) + (i % 7 == 0 ? 1e-6 : 0.0);
        }
}

/* Log of the speed over the typical one; 0 where unknown. */
static double gpvo_faster(const double *features) {
    double v2 = 0.0, ratio;
    int i;
    for (i = 0; i < 3; ++i) {
        double v = features[gpvo_base_column[i]];
        v2 += gpvo_known(v) ? v * v : (double)NAN;
    }
    ratio = log(sqrt(v2) > 1e-9 ? sqrt(v2) : 1e-9) - GPVO_LN_SPEED;
    return isfinite(v2) ? gpvo_clip(ratio, 0.0, log(20.0)) : 0.0;
}

/* Row j of the root of what a wrong calibration makes, of a variance; returns what is left of it. */
static double gpvo_of_calibration(const double *features, double dt_s, int j, double variance, double root[6]) {
    double sum = 0.0, steps = dt_s / GPVO_DT_S, left;
    int i, p;
    for (p = 0; p < 6; ++p) {
        root[p] = 0.0;
        for (i = 0; i < 6; ++i) {
            double v = features[gpvo_base_column[i]];
            if (gpvo_known(v)) root[p] += gpvo_calibration_patterns[(p * 6 + j) * 6 + i] * (v * steps);
        }
        sum += root[p] * root[p];
    }
    left = variance / (variance + sum);
    for (p = 0; p < 6; ++p) root[p] *= sqrt(left);
    return variance * (left < GPVO_LEAST_LEFT ? GPVO_LEAST_LEFT : left);
}

/* Standard deviations of jitter, white and bias on axis j, of a variance: what adds up gains on the jitter as the speed
 * grows, the bias on the noise as the variance grows. */
static void gpvo_divide(int j, double variance, double faster, double part[3][6]) {
    double gain = gpvo_growth[j] * faster, above = gpvo_growth[6 + j] * (log(variance) - gpvo_level[j]);
    double white = gpvo_share[6 + j] * exp(gain);
    double bias = gpvo_share[12 + j] * exp(gain + gpvo_clip(above, -60.0, 60.0));
    double whole = gpvo_share[j] + white + bias;
    part[0][j] = sqrt(variance * gpvo_share[j] / whole);
    part[1][j] = sqrt(variance * white / whole);
    part[2][j] = sqrt(variance * bias / whole);
}

/* The error of one motion that was measured. One that odometry lost, or that no vehicle can make, is a guess whose error is
 * far larger than this says, as it depends on how fast the vehicle was: leave it out. features: GPVO_N_FEATURES values in the
 * order above, NAN where missing. geometry: 6x6 covariance by the method named above for the correlations, or NULL. dt_s:
 * duration of the motion; what is none, such as 0, means the training's. Never fails; uses no heap and no state. */
static inline void gpvo_predict(const double *features, const double *geometry, double dt_s, gpvo_estimate *out) {
    double inside[GPVO_N_FEATURES], inputs[GPVO_N_INPUTS], ratio[6], spread[6], base[6], plain[6], R[3][36], part[3][6], limit[2], distance, outside, growth;
    double duration = dt_s >= GPVO_SHORTEST_S && dt_s <= GPVO_LONGEST_S ? dt_s : GPVO_DT_S, faster = gpvo_faster(features);
    int i, j;
    gpvo_base(features, duration, base, plain);
    distance = gpvo_locate(features, base, duration, inside);
    for (i = 0; i < GPVO_N_INPUTS; ++i) inputs[i] = inside[gpvo_input[i]];
    gpvo_log_ratio(inputs, ratio, spread);
    gpvo_correlations(geometry, R);
    gpvo_limits(features, duration, limit);
    out->distance = distance;
    out->nu = GPVO_NU;
    out->in_domain = exp(-0.5 * distance * distance);
    outside = 1.0 - out->in_domain;
    growth = pow(1.0 + distance, GPVO_OUTSIDE_POWER);
    for (j = 0; j < 6; ++j) {
        double log_noise = gpvo_clip(ratio[j] + 0.5 * spread[j], -GPVO_LN_LARGEST, GPVO_LN_LARGEST), known = base[j] * exp(log_noise - 0.5 * spread[j]), total, variance;
        double cautious = log_noise + outside * (gpvo_high[j] > log_noise ? gpvo_high[j] - log_noise : 0.0);
        out->mean[j] = 0.0;
        total = (base[j] + outside * (plain[j] > base[j] ? plain[j] - base[j] : 0.0)) * exp(cautious) * growth;
        variance = gpvo_within(total * gpvo_factor[j], limit[j / 3]);
        out->epistemic[j] = variance * (1.0 - known / total);
        gpvo_divide(j, gpvo_of_calibration(features, duration, j, variance, out->calibration_root + j * 6), faster, part);
    }
    for (i = 0; i < 6; ++i)
        for (j = 0; j < 6; ++j) {
            int at = i * 6 + j;
            out->jitter[at] = R[0][at] * part[0][i] * part[0][j];
            out->white[at] = R[1][at] * part[1][i] * part[1][j];
            out->bias[at] = R[2][at] * part[2][i] * part[2][j];
        }
    for (i = 0; i < 6; ++i)
        for (j = 0; j < 6; ++j) {
            int at = i * 6 + j, k;
            for (k = 0; k < 6; ++k) out->bias[at] += out->calibration_root[i * 6 + k] * out->calibration_root[j * 6 + k];
            out->covariance[i * 6 + j] = out->jitter[i * 6 + j] + out->white[i * 6 + j] + out->bias[i * 6 + j];
        }
    out->confidence = exp((GPVO_TYPICAL_LN_DET - gpvo_ln_det(out->covariance)) / 12.0);
    if (out->confidence > 1.0) out->confidence = 1.0;
    out->confidence *= out->in_domain;
}
