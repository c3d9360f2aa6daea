/* The floor: what plain C needs for the splat of taichi_edges/splatting, from the same parameters, cameras and selected
 * pixels. n Gaussians, images of height x width.
 *
 * A splat is (u, v, conic a, b, c, opacity), a box (u0, u1, v0, v1) with exclusive ends. The selected pixels stand in a
 * list of slots, row by row; `words` holds, for every 32 pixels of a row, the mask of the selected ones and the number
 * of those before it. Each thread draws into a plane of its own, of `capacity` slots, all 1 before and after `forward`.
 */
#include <math.h>
#include <omp.h>
#include <stdint.h>
#ifdef __SSE2__
#include <immintrin.h>
#endif

#define SCREEN_BLUR 0.3f
#define ALPHA_MIN (1.0f / 255.0f)
#define ALPHA_MAX 0.999f
#define BOX_SIGMAS 3.0f
#define NEAR_PLANE 0.05f
#define LOG2_E 1.44269504f
#define MIN(a, b) ((a) < (b) ? (a) : (b))
#define MAX(a, b) ((a) > (b) ? (a) : (b))

static inline int share_start(int count, int part, int parts) { return (int)((int64_t)count * part / parts); }
static inline float dot(const float *a, const float *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* A product of many factors gets denormal, which is slow; Taichi flushes such numbers to zero, so this does too. */
static inline void flush_denormals(void) {
#ifdef __SSE2__
    _mm_setcsr(_mm_getcsr() | 0x8040);
#endif
}

/* 2^x: the polynomial of the kernels, for every pixel of every splat, so that neither side wins by its exponential. */
static inline float fast_exp2(float x) {
    float bounded = MIN(MAX(x, -120.0f), 120.0f);
    float whole = floorf(bounded + 0.5f);
    float f = bounded - whole;
    float p = 1.32647271e-3f * f + 9.67151264e-3f;
    p = p * f + 5.55073374e-2f;
    p = p * f + 2.40222421e-1f;
    p = p * f + 6.93146978e-1f;
    p = p * f + 1.0f;
    union { int32_t bits; float value; } power = {((int32_t)whole + 127) << 23};
    return p * power.value;
}

/* A Gaussian and a camera -> splat and box. pose: world to camera, 3 x 4. pinhole: fx, fy, cx, cy. */
static inline void project(const float *mean, const float *log_scale, const float *q, float logit, const float *pose,
                           const float *pinhole, int width, int height, float *splat, int32_t *box) {
    float px = dot(pose, mean) + pose[3], py = dot(pose + 4, mean) + pose[7], depth = dot(pose + 8, mean) + pose[11];
    float inverse_depth = 1.0f / MAX(depth, NEAR_PLANE);
    float x = px * inverse_depth, y = py * inverse_depth;
    float two = 2.0f / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] + 1e-20f);
    float axes[3][3] = {
        {1 - two * (q[2] * q[2] + q[3] * q[3]), two * (q[1] * q[2] + q[0] * q[3]), two * (q[1] * q[3] - q[0] * q[2])},
        {two * (q[1] * q[2] - q[0] * q[3]), 1 - two * (q[1] * q[1] + q[3] * q[3]), two * (q[2] * q[3] + q[0] * q[1])},
        {two * (q[1] * q[3] + q[0] * q[2]), two * (q[2] * q[3] - q[0] * q[1]), 1 - two * (q[1] * q[1] + q[2] * q[2])}};
    float uu = 0, uv = 0, vv = 0; /* the covariance in pixels */
    for (int j = 0; j < 3; j++) {
        float away = dot(pose + 8, axes[j]), length = expf(log_scale[j]) * inverse_depth;
        float along_u = pinhole[0] * length * (dot(pose, axes[j]) - x * away);
        float along_v = pinhole[1] * length * (dot(pose + 4, axes[j]) - y * away);
        uu += along_u * along_u, uv += along_u * along_v, vv += along_v * along_v;
    }
    float blurred_uu = uu + SCREEN_BLUR, blurred_vv = vv + SCREEN_BLUR;
    float inverse = 1.0f / (blurred_uu * blurred_vv - uv * uv);
    float opacity = sqrtf(MAX((uu * vv - uv * uv) * inverse, 1e-8f)) / (1.0f + expf(-logit));
    float u = pinhole[0] * x + pinhole[2], v = pinhole[1] * y + pinhole[3];
    splat[0] = u, splat[1] = v, splat[5] = opacity;
    splat[2] = blurred_vv * inverse, splat[3] = -uv * inverse, splat[4] = blurred_uu * inverse;
    box[0] = box[1] = box[2] = box[3] = 0;
    if (depth < NEAR_PLANE || opacity < ALPHA_MIN) return;
    float reach = sqrtf(MIN(2.0f * logf(opacity / ALPHA_MIN), BOX_SIGMAS * BOX_SIGMAS));
    float reach_u = reach * sqrtf(blurred_uu), reach_v = reach * sqrtf(blurred_vv);
    int u0 = MAX(0, (int)ceilf(u - reach_u)), u1 = MIN(width, (int)floorf(u + reach_u) + 1);
    int v0 = MAX(0, (int)ceilf(v - reach_v)), v1 = MIN(height, (int)floorf(v + reach_v) + 1);
    if (u0 < u1 && v0 < v1) box[0] = u0, box[1] = u1, box[2] = v0, box[3] = v1;
}

/* First and last (exclusive) slot of the selected pixels in columns u0..u1-1 of a row; u0 < u1. */
static inline void slots_of(const uint32_t *row_words, int u0, int u1, int *start, int *end) {
    const uint32_t *first = row_words + 2 * (u0 >> 5), *last = row_words + 2 * ((u1 - 1) >> 5);
    *start = (int)first[1] + __builtin_popcount(first[0] & ~(0xFFFFFFFFu << (u0 & 31)));
    *end = (int)last[1] + __builtin_popcount(last[0] & (0xFFFFFFFFu >> (31 - ((u1 - 1) & 31))));
}

/* Parameters -> splats (n, 6), boxes (n, 4) and the planes. */
static void draw(int count, const float *means, const float *log_scales, const float *quaternions, const float *logits,
                 const float *pose, const float *pinhole, int width, int height, const uint32_t *words,
                 const float *columns, int capacity, int threads, float *splats, int32_t *boxes, float *planes) {
    int row_length = 2 * ((width + 31) / 32);
#pragma omp parallel num_threads(threads)
    {
        flush_denormals();
        int thread = omp_get_thread_num(), last = share_start(count, thread + 1, threads);
        float *plane = planes + (int64_t)thread * capacity;
        for (int64_t i = share_start(count, thread, threads); i < last; i++) {
            float *g = splats + 6 * i;
            int32_t *box = boxes + 4 * i;
            project(means + 3 * i, log_scales + 3 * i, quaternions + 4 * i, logits[i], pose, pinhole, width, height, g,
                    box);
            float u = g[0], a = -0.5f * LOG2_E * g[2], b = -LOG2_E * g[3], c = -0.5f * LOG2_E * g[4], opacity = g[5];
            for (int row = box[2]; row < box[3]; row++) {
                float dv = row - g[1];
                int start, end;
                slots_of(words + (int64_t)row * row_length, box[0], box[1], &start, &end);
                for (int slot = start; slot < end; slot++) {
                    float du = columns[slot] - u;
                    float alpha = opacity * fast_exp2((a * du + b * dv) * du + c * dv * dv);
                    plane[slot] *= 1.0f - (alpha >= ALPHA_MIN ? MIN(alpha, ALPHA_MAX) : 0.0f);
                }
            }
        }
    }
}

/* Planes -> transmittance and adjoint (-T dL/dT) of the slots; returns the loss. */
static float blend(int slots, int capacity, int threads, const float *targets, float level, const float *weights,
                   float *planes, float *transmittance, float *adjoint) {
    float loss = 0;
    for (int slot = 0; slot < slots; slot++) {
        float t = 1.0f;
        for (int thread = 0; thread < threads; thread++) {
            float *drawn = planes + (int64_t)thread * capacity + slot;
            t *= *drawn;
            *drawn = 1.0f;
        }
        float weight = targets[slot] >= level ? weights[0] : weights[1];
        float difference = 1.0f - t - targets[slot];
        transmittance[slot] = t;
        adjoint[slot] = difference > 0 ? weight * t : difference < 0 ? -weight * t : 0.0f;
        loss += weight * fabsf(difference);
    }
    return loss;
}

/* Parameters and a camera -> the loss and everything that `backward` needs. weights: of edge and background pixels. */
void forward(int count, const float *means, const float *log_scales, const float *quaternions, const float *logits,
             const float *pose, const float *pinhole, int width, int height, const uint32_t *words,
             const float *columns, const float *targets, int slots, float level, const float *weights, int capacity,
             int threads, float *splats, int32_t *boxes, float *planes, float *transmittance, float *adjoint,
             float *loss) {
    draw(count, means, log_scales, quaternions, logits, pose, pinhole, width, height, words, columns, capacity, threads,
         splats, boxes, planes);
    *loss = blend(slots, capacity, threads, targets, level, weights, planes, transmittance, adjoint);
}

/* Adjoint of the slots -> dL/d(splats) (n, 6) and the absolute pull on every centre (n,). */
void backward(int count, int width, const uint32_t *words, const float *columns, int threads, const float *splats,
              const int32_t *boxes, const float *adjoint, float *d_splats, float *pull) {
    int row_length = 2 * ((width + 31) / 32);
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int64_t i = 0; i < count; i++) {
        const float *g = splats + 6 * i;
        const int32_t *box = boxes + 4 * i;
        float a = g[2], b = g[3], c = g[4], opacity = g[5];
        float a2 = -0.5f * LOG2_E * a, b2 = -LOG2_E * b, c2 = -0.5f * LOG2_E * c;
        /* Sums over the pixels of dL / d(exponent) times 1, du, dv, du^2, du dv, dv^2. */
        float one = 0, u = 0, v = 0, uu = 0, uv = 0, vv = 0, pull_u = 0, pull_v = 0;
        for (int row = box[2]; row < box[3]; row++) {
            float dv = row - g[1];
            int start, end;
            slots_of(words + (int64_t)row * row_length, box[0], box[1], &start, &end);
            for (int slot = start; slot < end; slot++) {
                float du = columns[slot] - g[0];
                float alpha = opacity * fast_exp2((a2 * du + b2 * dv) * du + c2 * dv * dv);
                float slope = adjoint[slot] * alpha / (1.0f - MIN(alpha, ALPHA_MAX));
                float d_exponent = (alpha >= ALPHA_MIN) & (alpha < ALPHA_MAX) ? slope : 0.0f;
                float along_u = d_exponent * du, along_v = d_exponent * dv;
                one += d_exponent, u += along_u, v += along_v;
                uu += along_u * du, uv += along_u * dv, vv += along_v * dv;
                pull_u += fabsf(a * along_u + b * along_v);
                pull_v += fabsf(b * along_u + c * along_v);
            }
        }
        float *d = d_splats + 6 * i;
        d[0] = a * u + b * v, d[1] = b * u + c * v, d[2] = -0.5f * uu, d[3] = -uv, d[4] = -0.5f * vv;
        d[5] = one / MAX(opacity, 1e-30f);
        pull[i] = sqrtf(pull_u * pull_u + pull_v * pull_v);
    }
}
