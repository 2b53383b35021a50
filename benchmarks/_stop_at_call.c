/* Stops a process at the k-th system call that changes a folder; counted over all of its processes.

   Loaded by LD_PRELOAD. STOP_UNDER: the folder. STOP_COUNTER: a file of one long, the calls so far.
   STOP_AT: k, 0 to count only. STOP_SIGNAL: what the caller gets before the call is made. Where that
   is SIGKILL and the call is a write, half of the bytes are written first. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

static const char *under, *counter;
static long at, signal_number;
static long *calls;

__attribute__((constructor)) static void start(void) {
    under = getenv("STOP_UNDER"), counter = getenv("STOP_COUNTER");
    at = atol(getenv("STOP_AT")), signal_number = atol(getenv("STOP_SIGNAL"));
    int fd = open(counter, O_RDWR);
    calls = mmap(NULL, sizeof *calls, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    close(fd);
}

static int is_under(const char *path) { return strncmp(path, under, strlen(under)) == 0; }

static int fd_is_under(int fd) {
    char link[64], path[PATH_MAX];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    path[length < 0 ? 0 : length] = 0;
    return is_under(path);
}

static int entry_is_under(int folder, const char *path) {
    return path[0] == '/' || folder == AT_FDCWD ? is_under(path) : fd_is_under(folder);
}

static int is_it(void) { return calls != MAP_FAILED && __sync_add_and_fetch(calls, 1) == at; }

static void stop(void) { kill(getpid(), signal_number); }

#define CALL(type, name, is_counted, parameters, ...)                                  \
    type name parameters {                                                             \
        static type(*next) parameters;                                                 \
        if (!next) next = dlsym(RTLD_NEXT, #name);                                     \
        if ((is_counted) && is_it()) stop();                                           \
        return next(__VA_ARGS__);                                                      \
    }
#define WRITE(name, parameters, half, ...)                                             \
    ssize_t name parameters {                                                          \
        static ssize_t(*next) parameters;                                              \
        if (!next) next = dlsym(RTLD_NEXT, #name);                                     \
        if (fd_is_under(fd) && is_it()) {                                              \
            if (signal_number == SIGKILL) half;                                        \
            stop();                                                                    \
        }                                                                              \
        return next(__VA_ARGS__);                                                      \
    }
#define OPEN(name, folder, parameters, ...)                                            \
    int name parameters {                                                              \
        static int(*next) parameters;                                                  \
        if (!next) next = dlsym(RTLD_NEXT, #name);                                     \
        mode_t mode = 0;                                                               \
        if (flags & (O_CREAT | O_TRUNC)) {                                             \
            va_list rest;                                                              \
            va_start(rest, flags);                                                     \
            mode = va_arg(rest, mode_t);                                               \
            va_end(rest);                                                              \
            if (entry_is_under(folder, path) && is_it()) stop();                       \
        }                                                                              \
        return next(__VA_ARGS__);                                                      \
    }

WRITE(write, (int fd, const void *bytes, size_t n), (void)!next(fd, bytes, n / 2), fd, bytes, n)
WRITE(pwrite, (int fd, const void *bytes, size_t n, off_t offset), next(fd, bytes, n / 2, offset), fd, bytes, n, offset)
WRITE(pwrite64, (int fd, const void *bytes, size_t n, off64_t offset), next(fd, bytes, n / 2, offset), fd, bytes, n, offset)
WRITE(writev, (int fd, const struct iovec *parts, int n), next(fd, parts, n / 2), fd, parts, n)
WRITE(copy_file_range, (int from, off64_t *in, int fd, off64_t *out, size_t n, unsigned flags), next(from, in, fd, out, n / 2, flags), from, in, fd, out, n, flags)
WRITE(sendfile64, (int fd, int from, off64_t *offset, size_t n), next(fd, from, offset, n / 2), fd, from, offset, n)
OPEN(open, AT_FDCWD, (const char *path, int flags, ...), path, flags, mode)
OPEN(open64, AT_FDCWD, (const char *path, int flags, ...), path, flags, mode)
OPEN(openat, folder, (int folder, const char *path, int flags, ...), folder, path, flags, mode)
OPEN(openat64, folder, (int folder, const char *path, int flags, ...), folder, path, flags, mode)
CALL(int, fsync, fd_is_under(fd), (int fd), fd)
CALL(int, fdatasync, fd_is_under(fd), (int fd), fd)
CALL(int, ftruncate, fd_is_under(fd), (int fd, off_t n), fd, n)
CALL(int, ftruncate64, fd_is_under(fd), (int fd, off64_t n), fd, n)
CALL(int, rename, is_under(to), (const char *from, const char *to), from, to)
CALL(int, renameat, entry_is_under(b, to), (int a, const char *from, int b, const char *to), a, from, b, to)
CALL(int, link, is_under(to), (const char *from, const char *to), from, to)
CALL(int, linkat, entry_is_under(b, to), (int a, const char *from, int b, const char *to, int flags), a, from, b, to, flags)
CALL(int, unlink, is_under(path), (const char *path), path)
CALL(int, unlinkat, entry_is_under(folder, path), (int folder, const char *path, int flags), folder, path, flags)
CALL(int, mkdir, is_under(path), (const char *path, mode_t mode), path, mode)
CALL(int, mkdirat, entry_is_under(folder, path), (int folder, const char *path, mode_t mode), folder, path, mode)
CALL(int, rmdir, is_under(path), (const char *path), path)
