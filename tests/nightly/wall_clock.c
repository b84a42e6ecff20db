/* Preloaded (LD_PRELOAD) into a process: its wall clock is as far ahead as a file says, which may change while it runs.
 *
 * WALL_CLOCK_FILE has one int64_t of nanoseconds, in this machine's byte order. CLOCK_MONOTONIC, all sleeps and all waits
 * are left alone, as they are when somebody sets a machine's clock. (libfaketime 0.9.10 also turns absolute sleeps on
 * the monotonic clock, which Python's are, into EINVAL.)
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>

static const volatile int64_t *ahead_ns;
static int (*true_clock)(clockid_t, struct timespec *);

__attribute__((constructor)) static void begin(void) {
  const char *name = getenv("WALL_CLOCK_FILE");
  int file = name ? open(name, O_RDONLY | O_CLOEXEC) : -1;
  true_clock = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
  if (file < 0) abort(); /* nothing would be measured */
  void *page = mmap(NULL, sizeof(int64_t), PROT_READ, MAP_SHARED, file, 0);
  if (page == MAP_FAILED) abort();
  ahead_ns = page;
}

int clock_gettime(clockid_t clock, struct timespec *out) {
  if (!true_clock) true_clock = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
  int failed = true_clock(clock, out);
  if (!failed && ahead_ns && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) {
    int64_t ns = out->tv_nsec + *ahead_ns % 1000000000;
    out->tv_sec += *ahead_ns / 1000000000 + (ns >= 1000000000) - (ns < 0);
    out->tv_nsec = ns - 1000000000 * (ns >= 1000000000) + 1000000000 * (ns < 0);
  }
  return failed;
}

int gettimeofday(struct timeval *restrict out, void *restrict zone) {
  struct timespec now;
  (void)zone;
  if (clock_gettime(CLOCK_REALTIME, &now)) return -1;
  out->tv_sec = now.tv_sec;
  out->tv_usec = now.tv_nsec / 1000;
  return 0;
}

time_t time(time_t *out) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (out) *out = now.tv_sec;
  return now.tv_sec;
}
