/* Faults injected into the calls of a process: those on files below one folder, or those that
 * allocate memory.
 *
 * Preloaded (LD_PRELOAD). `faults_arm(folder, log, threshold, number, kind)` starts to count calls,
 * and the call of that number
 *   EIO_ONCE     fails with EIO,
 *   SHORT        is cut short if it writes,
 *   FULL         and all that need room after it report ENOSPC,
 *   KILL         is not made, because the process is killed before it,
 *   NO_MEMORY    and all allocations of at least `threshold` bytes after it return NULL,
 *   NO_BLOCK     returns NULL, if it allocates that much.
 * With number 0 the calls are counted only. With RECORD each change is appended to `log`, from which
 * the state of the disk after a power cut can be derived. `faults_calls()` returns the number of
 * calls, which lies in memory that a process shares with those that it forks. A process that crashes
 * prints the libraries that the crash occurred in.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <execinfo.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <time.h>
#include <unistd.h>

enum { EIO_ONCE = 1, SHORT, FULL, KILL, NO_MEMORY, NO_BLOCK, RECORD };
enum { PASS, FAIL, CUT };
enum { CREATE = 1, MKDIR, WRITE, RESIZE, SYNC, LINK, RENAME, REMOVE };

typedef struct {
    int32_t operation, path_length, other_length, reserved;
    int64_t number, inode, offset, length;
} Change;

static char folder[PATH_MAX];
static size_t folder_length, threshold;
static long number;
static int kind, log_file = -1;
static atomic_long *calls;
static pthread_mutex_t one_at_a_time = PTHREAD_MUTEX_INITIALIZER;

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

__attribute__((constructor)) static void begin(void)
{
    void *(*map)(void *, size_t, int, int, int, off_t) = dlsym(RTLD_NEXT, "mmap");
    calls = map(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
}

static void crashed(int signal_number)
{
    void *frames[40];
    const char *last = "";
    int count = backtrace(frames, 40);
    dprintf(2, "\ncrash, signal %d, in:", signal_number);
    for (int n = 0; n < count; n++) {
        Dl_info info;
        if (!dladdr(frames[n], &info) || !info.dli_fname)
            continue;
        const char *slash = strrchr(info.dli_fname, '/');
        const char *name = slash ? slash + 1 : info.dli_fname;
        if (strcmp(name, last) && strncmp(name, "faults", 6))
            dprintf(2, " %s(%s)", name, info.dli_sname ? info.dli_sname : "");
        last = name;
    }
    dprintf(2, "\n");
    signal(signal_number, SIG_DFL);
    raise(signal_number);
}

void faults_arm(const char *where, const char *log, size_t least, long which, int how)
{
    static char other_stack[1 << 16];
    stack_t stack = {.ss_sp = other_stack, .ss_size = sizeof other_stack};
    struct sigaction action = {.sa_handler = crashed, .sa_flags = SA_ONSTACK};
    int deadly[] = {SIGSEGV, SIGBUS, SIGABRT, SIGFPE, SIGILL};
    void *frames[4];
    backtrace(frames, 4); /* which loads a library at its first call */
    sigaltstack(&stack, NULL);
    for (size_t n = 0; n < sizeof deadly / sizeof *deadly; n++)
        sigaction(deadly[n], &action, NULL);
    folder_length = strlen(where);
    memcpy(folder, where, folder_length + 1);
    if (how == RECORD)
        log_file = REAL(open)(log, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0600);
    number = which;
    threshold = least;
    atomic_store(calls, 0);
    kind = how;
}

long faults_calls(void)
{
    return atomic_load(calls);
}

static int is_below(const char *path)
{
    return !strncmp(path, folder, folder_length) && path[folder_length] == '/';
}

static int path_of_file(int file, char *path)
{
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, PATH_MAX - 1);
    if (length < 0)
        return 0;
    path[length] = 0;
    return 1;
}

/* The absolute path of a name; `path` has room for twice PATH_MAX. */
static int path_of_name(int directory, const char *name, char *path)
{
    char parent[PATH_MAX];
    if (!folder_length || !name)
        return 0;
    if (name[0] == '/')
        snprintf(path, 2 * PATH_MAX, "%s", name);
    else if (directory == AT_FDCWD ? getcwd(parent, sizeof parent) != NULL
                                   : path_of_file(directory, parent))
        snprintf(path, 2 * PATH_MAX, "%s/%s", parent, name);
    else
        return 0;
    return 1;
}

static int lies_below(int file)
{
    char path[PATH_MAX];
    return folder_length && file >= 0 && path_of_file(file, path)
        && (is_below(path) || !strcmp(path, folder));
}

/* What becomes of the next call; `room` says whether it needs some, `writes` whether it can be cut. */
static int next(int below, int room, int writes, long *which)
{
    int before = errno;
    *which = 0;
    if (!below || !kind || kind == NO_MEMORY || kind == NO_BLOCK)
        return PASS;
    long now = *which = atomic_fetch_add(calls, 1) + 1;
    errno = before;
    if (!number)
        return PASS;
    if (kind == FULL && now >= number && room) {
        errno = ENOSPC;
        return FAIL;
    }
    if (now != number)
        return PASS;
    if (kind == KILL)
        kill(getpid(), SIGKILL);
    if (kind == EIO_ONCE) {
        errno = EIO;
        return FAIL;
    }
    return kind == SHORT && writes ? CUT : PASS;
}

static void enter(void)
{
    if (log_file >= 0)
        pthread_mutex_lock(&one_at_a_time);
}

static void put(const void *data, size_t size)
{
    const char *left = data;
    while (size) {
        ssize_t done = REAL(write)(log_file, left, size);
        if (done <= 0)
            _exit(99);
        left += done;
        size -= done;
    }
}

/* Append a change to the log, and let other threads go on. Empty paths need not be given. */
static void leave(int happened, Change change, const char *path, const char *other, const void *data)
{
    int before = errno;
    if (log_file < 0)
        return;
    if (happened && change.number) {
        change.path_length = path ? strlen(path) : 0;
        change.other_length = other ? strlen(other) : 0;
        put(&change, sizeof change);
        put(path, change.path_length);
        put(other, change.other_length);
        if (data)
            put(data, change.length);
    }
    pthread_mutex_unlock(&one_at_a_time);
    errno = before;
}

static int64_t inode_of(int file)
{
    struct stat status;
    return fstat(file, &status) ? 0 : (int64_t)status.st_ino;
}

static int64_t place_in(int file)
{
    struct stat status;
    int flags = fcntl(file, F_GETFL);
    if (flags >= 0 && flags & O_APPEND)
        return fstat(file, &status) ? 0 : status.st_size;
    return lseek(file, 0, SEEK_CUR);
}

#define COMMA ,
#define WRITES(name, place, start, ...)                                               \
    ssize_t name place                                                                \
    {                                                                                 \
        Change change = {.operation = WRITE};                                         \
        int fate = next(lies_below(file), 1, 1, &change.number);                      \
        if (fate == FAIL)                                                             \
            return -1;                                                                \
        enter();                                                                      \
        if (log_file >= 0) {                                                          \
            change.inode = inode_of(file);                                            \
            change.offset = start;                                                    \
        }                                                                             \
        ssize_t done = REAL(name)(file, data, fate == CUT ? (size + 1) / 2 : size __VA_ARGS__); \
        change.length = done;                                                         \
        leave(done > 0, change, NULL, NULL, data);                                    \
        return done;                                                                  \
    }
WRITES(write, (int file, const void *data, size_t size), place_in(file))
WRITES(pwrite, (int file, const void *data, size_t size, off_t at), at, COMMA at)
WRITES(pwrite64, (int file, const void *data, size_t size, off64_t at), at, COMMA at)

#define OPENS(name, declared, where, exists, call)                                    \
    int name declared                                                                 \
    {                                                                                 \
        va_list more;                                                                 \
        va_start(more, flags);                                                        \
        mode_t mode = flags & (O_CREAT | O_TMPFILE) ? va_arg(more, mode_t) : 0;       \
        va_end(more);                                                                 \
        char full[2 * PATH_MAX];                                                      \
        Change change = {.operation = CREATE};                                        \
        int below = path_of_name(where, path, full) && is_below(full);                \
        int makes = below && flags & O_CREAT && exists;                               \
        if (next(below, makes, 0, &change.number) == FAIL)                            \
            return -1;                                                                \
        enter();                                                                      \
        int file = call;                                                              \
        if (file >= 0)                                                                \
            change.inode = inode_of(file);                                            \
        if (!makes)                                                                   \
            change.operation = RESIZE;                                                \
        leave(file >= 0 && (makes || flags & O_TRUNC), change, full, NULL, NULL);     \
        return file;                                                                  \
    }
#define OPENED_HERE(name)                                                             \
    OPENS(name, (const char *path, int flags, ...), AT_FDCWD, access(path, F_OK),     \
          REAL(name)(path, flags, mode))
#define OPENED_THERE(name)                                                            \
    OPENS(name, (int directory, const char *path, int flags, ...), directory,         \
          faccessat(directory, path, F_OK, 0), REAL(name)(directory, path, flags, mode))
OPENED_HERE(open)
OPENED_HERE(open64)
OPENED_THERE(openat)
OPENED_THERE(openat64)

#define ON_FILE(name, declared, given, what, size)                                    \
    int name declared                                                                 \
    {                                                                                 \
        Change change = {.operation = what, .offset = size};                          \
        if (next(lies_below(file), 1, 0, &change.number) == FAIL)                     \
            return -1;                                                                \
        enter();                                                                      \
        if (log_file >= 0)                                                            \
            change.inode = inode_of(file);                                            \
        int done = REAL(name) given;                                                  \
        leave(!done, change, NULL, NULL, NULL);                                       \
        return done;                                                                  \
    }
ON_FILE(fsync, (int file), (file), SYNC, 0)
ON_FILE(fdatasync, (int file), (file), SYNC, 0)
ON_FILE(ftruncate, (int file, off_t size), (file, size), RESIZE, size)
ON_FILE(ftruncate64, (int file, off64_t size), (file, size), RESIZE, size)

#define ON_NAME(name, declared, given, what, from_where, from, where, path, room)     \
    int name declared                                                                 \
    {                                                                                 \
        char first[2 * PATH_MAX] = "", second[2 * PATH_MAX] = "";                     \
        Change change = {.operation = what};                                          \
        int below = path_of_name(where, path, first) && is_below(first);              \
        if (next(below, room, 0, &change.number) == FAIL)                             \
            return -1;                                                                \
        enter();                                                                      \
        path_of_name(from_where, from, second);                                       \
        int done = REAL(name) given;                                                  \
        struct stat status;                                                           \
        if (!done && what == MKDIR && !stat(first, &status))                          \
            change.inode = status.st_ino;                                             \
        leave(!done, change, first, second, NULL);                                    \
        return done;                                                                  \
    }
ON_NAME(link, (const char *from, const char *to), (from, to), LINK, AT_FDCWD, from, AT_FDCWD, to, 1)
ON_NAME(linkat, (int a, const char *from, int b, const char *to, int flags),
        (a, from, b, to, flags), LINK, a, from, b, to, 1)
ON_NAME(rename, (const char *from, const char *to), (from, to), RENAME, AT_FDCWD, from, AT_FDCWD,
        to, 0)
ON_NAME(renameat, (int a, const char *from, int b, const char *to), (a, from, b, to), RENAME, a,
        from, b, to, 0)
ON_NAME(unlink, (const char *path), (path), REMOVE, AT_FDCWD, NULL, AT_FDCWD, path, 0)
ON_NAME(unlinkat, (int a, const char *path, int flags), (a, path, flags), REMOVE, AT_FDCWD, NULL,
        a, path, 0)
ON_NAME(rmdir, (const char *path), (path), REMOVE, AT_FDCWD, NULL, AT_FDCWD, path, 0)
ON_NAME(mkdir, (const char *path, mode_t mode), (path, mode), MKDIR, AT_FDCWD, NULL, AT_FDCWD,
        path, 1)
ON_NAME(mkdirat, (int a, const char *path, mode_t mode), (a, path, mode), MKDIR, AT_FDCWD, NULL, a,
        path, 1)

/* The time of day stands still, so that two executions write the same bytes. */
int clock_gettime(clockid_t clock, struct timespec *time)
{
    int done = REAL(clock_gettime)(clock, time);
    if (!done && clock == CLOCK_REALTIME)
        *time = (struct timespec){.tv_sec = 1600000000};
    return done;
}

static int is_exhausted(size_t size)
{
    if ((kind != NO_MEMORY && kind != NO_BLOCK) || size < threshold)
        return 0;
    long now = atomic_fetch_add(calls, 1) + 1;
    if (!number || (kind == NO_MEMORY ? now < number : now != number))
        return 0;
    errno = ENOMEM;
    return 1;
}

extern void *__libc_malloc(size_t);
extern void *__libc_calloc(size_t, size_t);
extern void *__libc_realloc(void *, size_t);
extern void *__libc_memalign(size_t, size_t);

void *malloc(size_t size)
{
    return is_exhausted(size) ? NULL : __libc_malloc(size);
}

void *calloc(size_t count, size_t size)
{
    return is_exhausted(count * size) ? NULL : __libc_calloc(count, size);
}

void *realloc(void *block, size_t size)
{
    return is_exhausted(size) ? NULL : __libc_realloc(block, size);
}

void *aligned_alloc(size_t alignment, size_t size)
{
    return is_exhausted(size) ? NULL : __libc_memalign(alignment, size);
}

int posix_memalign(void **block, size_t alignment, size_t size)
{
    if (is_exhausted(size))
        return ENOMEM;
    *block = __libc_memalign(alignment, size);
    return *block ? 0 : ENOMEM;
}

#define MAPS(name, type)                                                              \
    void *name(void *address, size_t size, int access, int flags, int file, type at)  \
    {                                                                                 \
        long unused;                                                                  \
        if (next(file >= 0 && lies_below(file), 0, 0, &unused) == FAIL || is_exhausted(size)) \
            return MAP_FAILED;                                                        \
        return REAL(name)(address, size, access, flags, file, at);                    \
    }
MAPS(mmap, off_t)
MAPS(mmap64, off64_t)
