// Which of the compiled variants this processor can run.

#define OFFER extern "C" __attribute__((visibility("default"))) const char *

// Raised with every change of a signature or a structure, here and in agents/kernels/native.py: a library left over from an
// older installation is not used.
extern "C" __attribute__((visibility("default"))) int interface_version() { return 3; }

// The name of the best variant, or an empty text when this processor has none of their instruction sets.
OFFER best_variant() {
#if defined(__x86_64__)
  __builtin_cpu_init();
#ifdef HAVE_avx512
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("fma"))
    return "avx512";
#endif
#ifdef HAVE_avx2
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return "avx2";
#endif
#elif defined(__aarch64__)
#ifdef HAVE_neon
  return "neon";
#endif
#endif
  return "";
}

// The variants that were compiled, best first, separated by spaces.
OFFER compiled_variants() {
  return ""
#ifdef HAVE_avx512
         "avx512 "
#endif
#ifdef HAVE_avx2
         "avx2 "
#endif
#ifdef HAVE_neon
         "neon "
#endif
      ;
}
