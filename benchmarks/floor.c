/* The floor: what plain scalar C needs for the splat of taichi_edges/splatting/splat.py, over the same splats, boxes and
 * pixels. A splat is (u, v, conic a, b, c, opacity), a box (u0, u1, v0, v1) with exclusive ends; the mask has 32 pixels
 * in a word; images are row-major (height, width). Each thread draws into a plane of its own.
 */
#include <math.h>
#include <omp.h>
#include <stdint.h>
#ifdef __SSE2__
#include <immintrin.h>
#endif

#define ALPHA_MIN (1.0f / 255.0f)
#define ALPHA_MAX 0.999f

/* exp of x <= 0, the polynomial of the kernels, so that neither side wins by its exponential. */
static inline float fast_exp(float x) {
    float scaled = (x > -80.0f ? x : -80.0f) * 1.44269504f;
    float whole = floorf(scaled + 0.5f);
    float f = scaled - whole;
    float p = 1.32647271e-3f * f + 9.67151264e-3f;
    p = p * f + 5.55073374e-2f;
    p = p * f + 2.40222421e-1f;
    p = p * f + 6.93146978e-1f;
    p = p * f + 1.0f;
    union { int32_t bits; float value; } power = {((int32_t)whole + 127) << 23};
    return p * power.value;
}

/* The mask's word without the bits outside columns u0..u1-1. */
static inline uint32_t word_in_box(uint32_t bits, int word, int u0, int u1) {
    int first = word * 32;
    if (first < u0) bits &= 0xFFFFFFFFu << (u0 - first);
    if (first + 32 > u1) bits &= 0xFFFFFFFFu >> (first + 32 - u1);
    return bits;
}

/* A product of many factors gets denormal, which is slow; Taichi's threads flush such numbers to zero, so these do too. */
static inline void flush_denormals(void) {
#ifdef __SSE2__
    _mm_setcsr(_mm_getcsr() | 0x8040);
#endif
}

static inline int share_start(int count, int part, int parts) { return (int)((int64_t)count * part / parts); }

/* T = 1 at the selected pixels of every plane. */
void clear(int slots, const int32_t *pixels, int plane_size, int threads, float *planes) {
    for (int plane = 0; plane < threads; plane++)
        for (int slot = 0; slot < slots; slot++) planes[(int64_t)plane * plane_size + pixels[slot]] = 1.0f;
}

/* splats -> transmittance of the slots. */
void forward(int count, const float *splats, const int32_t *boxes, const uint32_t *mask, int words, int width,
             int plane_size, int slots, const int32_t *pixels, int threads, float *planes, float *transmittance) {
#pragma omp parallel num_threads(threads)
    {
        flush_denormals();
        int thread = omp_get_thread_num();
        float *plane = planes + (int64_t)thread * plane_size;
        int end = share_start(count, thread + 1, threads);
        for (int i = share_start(count, thread, threads); i < end; i++) {
            const float *g = splats + 6 * (int64_t)i;
            const int32_t *box = boxes + 4 * (int64_t)i;
            float u = g[0], v = g[1], a = -0.5f * g[2], b = -g[3], c = -0.5f * g[4], opacity = g[5];
            int u0 = box[0], u1 = box[1];
            for (int row = box[2]; row < box[3]; row++) {
                float dv = row - v;
                float *pixel_row = plane + (int64_t)row * width;
                for (int word = u0 >> 5; word <= (u1 - 1) >> 5; word++) {
                    uint32_t bits = word_in_box(mask[row * words + word], word, u0, u1);
                    while (bits) {
                        int column = word * 32 + __builtin_ctz(bits);
                        bits &= bits - 1;
                        float du = column - u;
                        float alpha = opacity * fast_exp((a * du + b * dv) * du + c * dv * dv);
                        if (alpha >= ALPHA_MIN) pixel_row[column] *= 1.0f - (alpha < ALPHA_MAX ? alpha : ALPHA_MAX);
                    }
                }
            }
        }
    }
    for (int slot = 0; slot < slots; slot++) {
        float value = planes[pixels[slot]];
        for (int plane = 1; plane < threads; plane++) value *= planes[(int64_t)plane * plane_size + pixels[slot]];
        transmittance[slot] = value;
    }
}

/* dL/dT of the slots -> dL/d(splats) (count, 6) and the absolute pull on every centre (count). adjoint: an image. */
void backward(int count, const float *splats, const int32_t *boxes, const uint32_t *mask, int words, int width,
              int slots, const int32_t *pixels, const float *transmittance, const float *d_transmittance, int threads,
              float *adjoint, float *d_splats, float *pull) {
    for (int slot = 0; slot < slots; slot++) adjoint[pixels[slot]] = d_transmittance[slot] * transmittance[slot];
#pragma omp parallel for num_threads(threads) schedule(static)
    for (int i = 0; i < count; i++) {
        const float *g = splats + 6 * (int64_t)i;
        const int32_t *box = boxes + 4 * (int64_t)i;
        float u = g[0], v = g[1], a = g[2], b = g[3], c = g[4], opacity = g[5];
        float d_u = 0, d_v = 0, d_a = 0, d_b = 0, d_c = 0, d_opacity = 0, pull_u = 0, pull_v = 0;
        int u0 = box[0], u1 = box[1];
        for (int row = box[2]; row < box[3]; row++) {
            float dv = row - v;
            const float *adjoint_row = adjoint + (int64_t)row * width;
            for (int word = u0 >> 5; word <= (u1 - 1) >> 5; word++) {
                uint32_t bits = word_in_box(mask[row * words + word], word, u0, u1);
                while (bits) {
                    int column = word * 32 + __builtin_ctz(bits);
                    bits &= bits - 1;
                    float du = column - u;
                    float falloff = fast_exp(-0.5f * (a * du * du + c * dv * dv) - b * du * dv);
                    float alpha = opacity * falloff;
                    if (alpha >= ALPHA_MIN && alpha < ALPHA_MAX) {
                        float d_alpha = -adjoint_row[column] / (1.0f - alpha);
                        float d_exponent = d_alpha * alpha;
                        float towards_u = d_exponent * (a * du + b * dv), towards_v = d_exponent * (b * du + c * dv);
                        d_opacity += d_alpha * falloff;
                        d_a -= 0.5f * d_exponent * du * du;
                        d_b -= d_exponent * du * dv;
                        d_c -= 0.5f * d_exponent * dv * dv;
                        d_u += towards_u;
                        d_v += towards_v;
                        pull_u += fabsf(towards_u);
                        pull_v += fabsf(towards_v);
                    }
                }
            }
        }
        float *d = d_splats + 6 * (int64_t)i;
        d[0] = d_u, d[1] = d_v, d[2] = d_a, d[3] = d_b, d[4] = d_c, d[5] = d_opacity;
        pull[i] = sqrtf(pull_u * pull_u + pull_v * pull_v);
    }
}
