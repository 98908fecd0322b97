// A window of a network S1-S4 by its spikes: what jaxsnn/window.py does with matrix products.
//
// Two calls of the foreign function interface of XLA, both over leading axes of robots. `fire` adds
// up the rows of weights of the inputs that spike; `remember` adds to the eligibility of a
// synapse once for every spike of its presynaptic neuron, since all that the postsynaptic spikes
// of the window have to say about a spike at step s is one number per neuron and s.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "xla/ffi/api/ffi.h"

// The loops over neurons have no turn that depends on another one.
#if defined(__clang__)
#define EACH _Pragma("clang loop vectorize(enable)")
#else
#define EACH _Pragma("GCC ivdep")
#endif

namespace ffi = xla::ffi;
using In = ffi::Buffer<ffi::F32>;
using Out = ffi::ResultBuffer<ffi::F32>;

namespace {

// Membrane constants of one layer, as `fire` of calls.py packs them.
struct Layer {
  float leak, rest, reset, threshold, pause;
};

// One Euler step of neurons.lif_step for n neurons; the order of operations is the same.
inline void Step(const Layer& c, float dt, int64_t n, const float* jump, float* v, float* left,
                 float* spike) {
  const float active = 0.5f * dt;
  EACH
  for (int64_t j = 0; j < n; ++j) {
    const float rest = std::max(left[j] - dt, 0.0f);
    const bool on = rest <= active;
    float u = on ? std::fma(c.leak, c.rest - v[j], v[j]) : v[j];
    const bool fires = on && u > c.threshold;
    u = on ? u + jump[j] : u;
    v[j] = fires ? c.reset : u;
    left[j] = fires ? c.pause : rest;
    spike[j] = fires ? 1.0f : 0.0f;
  }
}

// Indices of what is not zero; most is, so two are looked at together.
inline int64_t Nonzero(const float* x, int64_t n, int32_t* found) {
  int64_t count = 0, i = 0;
  for (; i + 1 < n; i += 2) {
    uint64_t both;
    std::memcpy(&both, x + i, sizeof(both));
    if (both == 0) continue;
    if (x[i] != 0.0f) found[count++] = static_cast<int32_t>(i);
    if (x[i + 1] != 0.0f) found[count++] = static_cast<int32_t>(i + 1);
  }
  if (i < n && x[i] != 0.0f) found[count++] = static_cast<int32_t>(i);
  return count;
}

// Spikes of a layer [steps, n] by neuron: steps[start[i]] .. steps[start[i + 1]] of neuron i.
struct ByNeuron {
  std::vector<int32_t> start, steps, at, found;

  void Read(const float* spikes, int64_t n_steps, int64_t n, int64_t stride) {
    start.assign(n + 1, 0);
    at.clear();
    found.resize(n + 1);
    std::vector<int32_t>& who = found;
    for (int64_t t = 0; t < n_steps; ++t) {
      const int64_t count = Nonzero(spikes + t * stride, n, who.data());
      for (int64_t k = 0; k < count; ++k) {
        ++start[who[k] + 1];
        at.push_back(who[k]);
        at.push_back(static_cast<int32_t>(t));
      }
    }
    for (int64_t i = 0; i < n; ++i) start[i + 1] += start[i];
    steps.resize(at.size() / 2);
    std::vector<int32_t> next(start.begin(), start.end() - 1);
    for (size_t k = 0; k < at.size(); k += 2) steps[next[at[k]]++] = at[k + 1];
  }
};

// Factors of one step, and of a spike pair that is complete at step t: `weight[0]` in z at the end
// of the window, `weight[1]` in its integral.
struct Decay {
  double plus, minus, z;
  float a_plus, a_minus, carry[2];
  std::vector<float> weight[2], after;  // after[s]: of a spike at s in its own trace at the end

  // `c`: time constant of z, dt over those of the traces and of z, amplitudes.
  Decay(const float* c, int64_t n_steps, double dt)
      : plus(std::exp(-double{c[1]})), minus(std::exp(-double{c[2]})), z(std::exp(-double{c[3]})),
        a_plus(c[4]), a_minus(c[5]) {
    for (auto& w : weight) w.resize(n_steps);
    after.resize(n_steps);
    double kept = 1.0, sum = 1.0, trace = 1.0;
    for (int64_t t = n_steps - 1; t >= 0; --t) {
      weight[0][t] = static_cast<float>(kept / c[0]);
      weight[1][t] = static_cast<float>(sum * dt / c[0]);
      after[t] = static_cast<float>(a_plus * trace);
      kept *= z;
      sum = 1.0 + z * sum;
      trace *= plus;
    }
    carry[0] = static_cast<float>(kept);
    carry[1] = static_cast<float>((sum - 1.0) * dt);
    end_plus = static_cast<float>(trace);
  }
  float end_plus;
};

// A factor in two floats: what one lacks would add up over the steps of a window.
struct Factor {
  float high, low;
  explicit Factor(double x) : high(static_cast<float>(x)), low(static_cast<float>(x - high)) {}
  float operator()(float x, float more) const {
    return std::fma(high, x, std::fma(low, x, more));
  }
};

// What the postsynaptic spikes [steps, n] make of a presynaptic spike at each step, [steps, 2, n].
struct Folded {
  std::vector<float> of, causal, anti, old, sum;

  // `trace` is the postsynaptic trace; it is carried to the end of the window.
  void Make(const Decay& d, const float* post, int64_t n_steps, int64_t n, int64_t stride,
            float* trace) {
    of.resize(n_steps * 2 * n);
    old.assign(2 * n, 0.0f);
    sum.assign(2 * n, 0.0f);
    float* c0 = old.data();
    float* c1 = c0 + n;
    const Factor plus(d.plus), minus(d.minus);
    for (int64_t s = n_steps - 1; s >= 0; --s) {
      const float w0 = d.weight[0][s], w1 = d.weight[1][s];
      const float* o = post + s * stride;
      float* f0 = of.data() + s * 2 * n;
      float* f1 = f0 + n;
      EACH
      for (int64_t j = 0; j < n; ++j) {
        c0[j] = plus(c0[j], w0 * o[j]);
        c1[j] = plus(c1[j], w1 * o[j]);
        f0[j] = d.a_plus * c0[j];
        f1[j] = d.a_plus * c1[j];
      }
    }
    EACH
    for (int64_t j = 0; j < 2 * n; ++j) old[j] = plus(old[j], 0.0f);
    float* s0 = sum.data();
    float* s1 = s0 + n;
    for (int64_t s = 0; s < n_steps; ++s) {
      const float w0 = d.weight[0][s], w1 = d.weight[1][s];
      const float* o = post + s * stride;
      float* f0 = of.data() + s * 2 * n;
      float* f1 = f0 + n;
      EACH
      for (int64_t j = 0; j < n; ++j) {
        trace[j] = minus(trace[j], d.a_minus * o[j]);
        f0[j] = std::fma(w0, trace[j], f0[j]);
        f1[j] = std::fma(w1, trace[j], f1[j]);
        s0[j] += f0[j];
        s1[j] += f1[j];
      }
    }
  }
};

// The row of eligibilities of presynaptic neuron i, and its own trace.
inline void Row(const Decay& d, const Folded& f, const ByNeuron& pre, int64_t i, int64_t n,
                float keep, float centre, float* trace, const float* z_before, float* z,
                float* total) {
  const float p = keep * *trace;
  const float carry0 = keep * d.carry[0], carry1 = keep * d.carry[1];
  const float *old = f.old.data(), *sum = f.sum.data();
  EACH
  for (int64_t j = 0; j < n; ++j) {
    const float before = z_before[j];
    z[j] = carry0 * before + (p * old[j] - centre * sum[j]);
    total[j] = carry1 * before + (p * old[n + j] - centre * sum[n + j]);
  }
  float own = d.end_plus * p;
  for (int32_t k = pre.start[i]; k < pre.start[i + 1]; ++k) {
    const int32_t s = pre.steps[k];
    const float* f0 = f.of.data() + static_cast<int64_t>(s) * 2 * n;
    EACH
    for (int64_t j = 0; j < n; ++j) z[j] += f0[j];
    EACH
    for (int64_t j = 0; j < n; ++j) total[j] += f0[n + j];
    own += d.after[s];
  }
  if (centre != 0.0f) {
    float all = 0.0f;
    for (const float a : d.after) all += a;
    own -= centre * all;
  }
  *trace = own;
}

int64_t Lead(const In& x, size_t rank) {
  int64_t count = 1;
  const auto dims = x.dimensions();
  for (size_t k = 0; k + rank < dims.size(); ++k) count *= dims[k];
  return count;
}

ffi::Error Fire(In weights, In signed_output, In sign_in, In v_in, In left_in, In v_motor_in,
                In left_motor_in, In pre, In constants, Out v, Out left, Out v_motor,
                Out left_motor, Out spikes, Out motors) {
  const auto w_dims = weights.dimensions();
  const auto p_dims = pre.dimensions();
  const int64_t n_in = w_dims[w_dims.size() - 2], n = w_dims.back(), half = n / 2;
  const int64_t n_steps = p_dims[p_dims.size() - 2], robots = Lead(weights, 2);
  std::vector<float> jump(n);
  std::vector<int32_t> found(std::max(n_in, n) + 1);
  for (int64_t b = 0; b < robots; ++b) {
    const float* c = constants.typed_data() + b * constants.dimensions().back();
    const float dt = c[0], gain = c[1];
    const Layer hidden{c[2], c[3], c[4], c[5], c[6]}, motor{c[7], c[8], c[9], c[10], c[11]};
    const float* w = weights.typed_data() + b * n_in * n;
    const float* sign = sign_in.typed_data() + b * n_in;
    const float* out = signed_output.typed_data() + b * n;
    float *u = v->typed_data() + b * n, *r = left->typed_data() + b * n;
    float *um = v_motor->typed_data() + b * 2, *rm = left_motor->typed_data() + b * 2;
    std::copy_n(v_in.typed_data() + b * n, n, u);
    std::copy_n(left_in.typed_data() + b * n, n, r);
    std::copy_n(v_motor_in.typed_data() + b * 2, 2, um);
    std::copy_n(left_motor_in.typed_data() + b * 2, 2, rm);
    for (int64_t t = 0; t < n_steps; ++t) {
      const int64_t count = Nonzero(pre.typed_data() + (b * n_steps + t) * n_in, n_in, found.data());
      std::fill(jump.begin(), jump.end(), 0.0f);
      int64_t k = 0;
      float* to = jump.data();
      // Four rows at a time, added one after the other as the matrix product does.
      for (; k + 3 < count; k += 4) {
        const float s0 = sign[found[k]], s1 = sign[found[k + 1]], s2 = sign[found[k + 2]],
                    s3 = sign[found[k + 3]];
        const float *r0 = w + found[k] * n, *r1 = w + found[k + 1] * n,
                    *r2 = w + found[k + 2] * n, *r3 = w + found[k + 3] * n;
        EACH
        for (int64_t j = 0; j < n; ++j)
          to[j] = (((to[j] + s0 * r0[j]) + s1 * r1[j]) + s2 * r2[j]) + s3 * r3[j];
      }
      for (; k < count; ++k) {
        const float s = sign[found[k]];
        const float* row = w + found[k] * n;
        EACH
        for (int64_t j = 0; j < n; ++j) to[j] += s * row[j];
      }
      EACH
      for (int64_t j = 0; j < n; ++j) jump[j] *= gain;
      float* spike = spikes->typed_data() + (b * n_steps + t) * n;
      Step(hidden, dt, n, jump.data(), u, r, spike);
      float to_motor[2] = {0.0f, 0.0f};
      const int64_t fired = Nonzero(spike, n, found.data());
      for (int64_t k = 0; k < fired; ++k) to_motor[found[k] >= half] += out[found[k]];
      Step(motor, dt, 2, to_motor, um, rm, motors->typed_data() + (b * n_steps + t) * 2);
    }
  }
  return ffi::Error::Success();
}

ffi::Error Remember(In plus_in, In minus_in, In z_in, In plus_motor_in, In minus_motor_in,
                    In z_motor_in, In pre, In spikes, In motors, In centre_in, In centre_hidden,
                    In constants, Out plus, Out minus, Out z, Out total, Out plus_motor,
                    Out minus_motor, Out z_motor, Out total_motor) {
  const auto z_dims = z_in.dimensions();
  const auto p_dims = pre.dimensions();
  const int64_t n_in = z_dims[z_dims.size() - 2], n = z_dims.back(), half = n / 2;
  const int64_t n_steps = p_dims[p_dims.size() - 2], robots = Lead(z_in, 2);
  ByNeuron by;
  Folded folded;
  for (int64_t b = 0; b < robots; ++b) {
    const float* c = constants.typed_data() + b * constants.dimensions().back();
    const float keep = c[1];
    const Decay decay(c + 2, n_steps, c[0]);
    const float* o = spikes.typed_data() + b * n_steps * n;
    const float* m = motors.typed_data() + b * n_steps * 2;

    float* pm = minus->typed_data() + b * n;
    EACH
    for (int64_t j = 0; j < n; ++j) pm[j] = keep * minus_in.typed_data()[b * n + j];
    folded.Make(decay, o, n_steps, n, n, pm);
    by.Read(pre.typed_data() + b * n_steps * n_in, n_steps, n_in, n_in);
    std::copy_n(plus_in.typed_data() + b * n_in, n_in, plus->typed_data() + b * n_in);
    for (int64_t i = 0; i < n_in; ++i) {
      const int64_t at = (b * n_in + i) * n;
      Row(decay, folded, by, i, n, keep, centre_in.typed_data()[b * n_in + i],
          plus->typed_data() + b * n_in + i, z_in.typed_data() + at, z->typed_data() + at,
          total->typed_data() + at);
    }

    by.Read(o, n_steps, n, n);
    std::copy_n(plus_motor_in.typed_data() + b * n, n, plus_motor->typed_data() + b * n);
    for (int64_t side = 0; side < 2; ++side) {
      float* trace = minus_motor->typed_data() + b * 2 + side;
      *trace = keep * minus_motor_in.typed_data()[b * 2 + side];
      folded.Make(decay, m + side, n_steps, 1, 2, trace);
      for (int64_t i = side * half; i < (side + 1) * half; ++i) {
        const int64_t at = b * n + i;
        Row(decay, folded, by, i, 1, keep, centre_hidden.typed_data()[at],
            plus_motor->typed_data() + at, z_motor_in.typed_data() + at,
            z_motor->typed_data() + at, total_motor->typed_data() + at);
      }
    }
  }
  return ffi::Error::Success();
}

}  // namespace

#define ARG .Arg<In>()
#define RET .Ret<In>()
XLA_FFI_DEFINE_HANDLER_SYMBOL(jaxsnn_fire, Fire,
                              ffi::Ffi::Bind() ARG ARG ARG ARG ARG ARG ARG ARG ARG RET RET RET RET
                                  RET RET);
XLA_FFI_DEFINE_HANDLER_SYMBOL(jaxsnn_remember, Remember,
                              ffi::Ffi::Bind() ARG ARG ARG ARG ARG ARG ARG ARG ARG ARG ARG ARG RET
                                  RET RET RET RET RET RET RET);
