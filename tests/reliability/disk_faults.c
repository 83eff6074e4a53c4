/* Faults of a disk, injected into the calls of a process on files below one folder.
 *
 * Preloaded (LD_PRELOAD). `disk_faults_arm(folder, number, kind)` starts to count: the call of that
 * number fails with EIO (kind 1), is cut short where it writes (2), or it and all that need room
 * after it report ENOSPC (3); with number 0 calls are counted only. `disk_faults_calls()` returns how
 * many there were. The counter lies in memory that a process shares with those that it forks.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

enum { EIO_ONCE = 1, SHORT = 2, FULL = 3 };
enum { PASS, FAIL, CUT };

static char folder[PATH_MAX];
static size_t folder_length;
static long number;
static int kind;
static atomic_long *calls;

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

__attribute__((constructor)) static void begin(void)
{
    void *(*map)(void *, size_t, int, int, int, off_t) = dlsym(RTLD_NEXT, "mmap");
    calls = map(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
}

void disk_faults_arm(const char *where, long which, int how)
{
    folder_length = strlen(where);
    memcpy(folder, where, folder_length + 1);
    number = which;
    kind = how;
    atomic_store(calls, 0);
}

long disk_faults_calls(void)
{
    return atomic_load(calls);
}

static int is_below(const char *path)
{
    return !strncmp(path, folder, folder_length) && path[folder_length] == '/';
}

static int names_below(int directory, const char *name)
{
    char parent[PATH_MAX], joined[2 * PATH_MAX], link[64];
    if (!folder_length || !name)
        return 0;
    if (name[0] == '/')
        return is_below(name);
    if (directory == AT_FDCWD) {
        if (!getcwd(parent, sizeof parent))
            return 0;
    } else {
        snprintf(link, sizeof link, "/proc/self/fd/%d", directory);
        ssize_t length = readlink(link, parent, sizeof parent - 1);
        if (length < 0)
            return 0;
        parent[length] = 0;
    }
    snprintf(joined, sizeof joined, "%s/%s", parent, name);
    return is_below(joined);
}

static int lies_below(int descriptor)
{
    char link[64], path[PATH_MAX];
    if (!folder_length || descriptor < 0)
        return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0)
        return 0;
    path[length] = 0;
    return is_below(path) || !strcmp(path, folder);
}

/* What becomes of the next call; `room` says whether it needs some, `writes` whether it can be cut. */
static int next(int below, int room, int writes)
{
    int before = errno;
    if (!below)
        return PASS;
    long now = atomic_fetch_add(calls, 1) + 1;
    errno = before;
    if (!number)
        return PASS;
    if (kind == FULL && now >= number && room) {
        errno = ENOSPC;
        return FAIL;
    }
    if (now != number)
        return PASS;
    if (kind == EIO_ONCE) {
        errno = EIO;
        return FAIL;
    }
    return kind == SHORT && writes ? CUT : PASS;
}

#define WRITES(name, place, offset)                                                   \
    ssize_t name place                                                                \
    {                                                                                 \
        int fate = next(lies_below(file), 1, 1);                                      \
        if (fate == FAIL)                                                             \
            return -1;                                                                \
        return REAL(name)(file, data, fate == CUT ? (size + 1) / 2 : size offset);    \
    }
#define COMMA ,
WRITES(write, (int file, const void *data, size_t size), )
WRITES(pwrite, (int file, const void *data, size_t size, off_t at), COMMA at)
WRITES(pwrite64, (int file, const void *data, size_t size, off64_t at), COMMA at)

#define OPENS(name)                                                                   \
    int name(const char *path, int flags, ...)                                        \
    {                                                                                 \
        va_list more;                                                                 \
        va_start(more, flags);                                                        \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(more, mode_t) : 0;       \
        va_end(more);                                                                 \
        int makes = (flags & O_CREAT) && names_below(AT_FDCWD, path);                 \
        if (makes && next(1, access(path, F_OK), 0) == FAIL)                          \
            return -1;                                                                \
        return REAL(name)(path, flags, mode);                                         \
    }
#define OPENS_AT(name)                                                                \
    int name(int directory, const char *path, int flags, ...)                         \
    {                                                                                 \
        va_list more;                                                                 \
        va_start(more, flags);                                                        \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(more, mode_t) : 0;       \
        va_end(more);                                                                 \
        int makes = (flags & O_CREAT) && names_below(directory, path);                \
        if (makes && next(1, faccessat(directory, path, F_OK, 0), 0) == FAIL)         \
            return -1;                                                                \
        return REAL(name)(directory, path, flags, mode);                              \
    }
OPENS(open)
OPENS(open64)
OPENS_AT(openat)
OPENS_AT(openat64)

#define ON_FILE(name, declared, given, room)                                          \
    int name declared                                                                 \
    {                                                                                 \
        return next(lies_below(file), room, 0) == FAIL ? -1 : REAL(name) given;       \
    }
ON_FILE(fsync, (int file), (file), 1)
ON_FILE(fdatasync, (int file), (file), 1)
ON_FILE(ftruncate, (int file, off_t size), (file, size), 1)
ON_FILE(ftruncate64, (int file, off64_t size), (file, size), 1)

#define ON_NAME(name, declared, given, directory, path, room)                         \
    int name declared                                                                 \
    {                                                                                 \
        return next(names_below(directory, path), room, 0) == FAIL ? -1 : REAL(name) given; \
    }
ON_NAME(link, (const char *from, const char *to), (from, to), AT_FDCWD, to, 1)
ON_NAME(linkat, (int a, const char *from, int b, const char *to, int flags),
        (a, from, b, to, flags), b, to, 1)
ON_NAME(rename, (const char *from, const char *to), (from, to), AT_FDCWD, to, 0)
ON_NAME(renameat, (int a, const char *from, int b, const char *to), (a, from, b, to), b, to, 0)
ON_NAME(unlink, (const char *path), (path), AT_FDCWD, path, 0)
ON_NAME(unlinkat, (int a, const char *path, int flags), (a, path, flags), a, path, 0)
ON_NAME(mkdir, (const char *path, mode_t mode), (path, mode), AT_FDCWD, path, 1)

#define MAPS(name, type)                                                              \
    void *name(void *address, size_t size, int access, int flags, int file, type at)  \
    {                                                                                 \
        int below = file >= 0 && lies_below(file);                                    \
        if (below && next(1, 0, 0) == FAIL)                                           \
            return MAP_FAILED;                                                        \
        return REAL(name)(address, size, access, flags, file, at);                    \
    }
MAPS(mmap, off_t)
MAPS(mmap64, off64_t)
