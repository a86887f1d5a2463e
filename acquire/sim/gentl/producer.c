/* A GenTL producer whose cameras are files: registers, XML and lines come from acquire.sim.gentl (Python).
 *
 *   directory of this .cti    host.ports          register spaces of system and interface
 *                             SERIAL.camera       one simulated camera: see layout.py
 *
 * The producer interprets a handful of registers (layout.h); everything else that the XML describes is memory.
 * A thread per stream takes lines out of the camera's ring, cuts Width x BufferHeight out of them, packs them
 * according to PixelFormat and fills the announced buffers. It never waits for a buffer: lines without one
 * are lost and counted, as in a frame grabber. Injected faults happen here.
 *
 * The declarations are our own, according to the GenICam GenTL standard 1.6.
 */
#define _GNU_SOURCE
#include <dirent.h>
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "layout.h"

#define API __attribute__((visibility("default")))
#define MAX_CAMERAS 16
#define TICK_NS 300000L      /* period at which an idle stream polls for lines */
#define ANSWER_NS 3000000000L /* time limit for an answer of the feeding side */

typedef int32_t gc_error;
enum {
    OK = 0, E_ERROR = -1001, E_NOT_INITIALIZED = -1002, E_NOT_IMPLEMENTED = -1003, E_IN_USE = -1004,
    E_ACCESS = -1005, E_HANDLE = -1006, E_ID = -1007, E_NO_DATA = -1008, E_PARAMETER = -1009, E_IO = -1010,
    E_TIMEOUT = -1011, E_ABORT = -1012, E_BUFFER = -1013, E_NOT_AVAILABLE = -1014, E_ADDRESS = -1015,
    E_TOO_SMALL = -1016, E_INDEX = -1017, E_BUSY = -1022
};
enum { T_STRING = 1, T_INT32 = 5, T_UINT32 = 6, T_UINT64 = 8, T_PTR = 10, T_BOOL8 = 11, T_SIZET = 12, T_BUFFER = 13 };
enum { STREAM_FIFO = 0, EVENT_NEW_BUFFER = 1 };

typedef uint64_t word;

/* ---- data structures */

struct port {
    const char *name;
    uint8_t *space;
    struct device *device; /* of the three ports of a camera */
    int number;
};

struct buffer {
    uint8_t *memory;
    size_t size, filled;
    void *user;
    int ours, queued, waiting, incomplete, too_large;
    word frame_id, time_ns, height, width, offset, format, padding;
    struct buffer *next;     /* next in the queue */
    struct buffer *next_all; /* next of the stream */
};

struct queue { struct buffer *first, *last; size_t count; };

struct stream {
    struct port port;
    struct device *device;
    pthread_mutex_t lock;
    pthread_cond_t news;
    pthread_t thread;
    int running, end, killed, registered;
    struct buffer *all;
    struct queue input, output;
    word session; /* when the stream was started: even, the camera idles */
    word announced, delivered, underruns, started, fired;
};

struct device {
    int fd;
    word *words;
    size_t size;
    word plugged; /* value of PLUGGED when this handle was made */
    int open;
    char serial[64];
    struct port remote, local;
    struct stream *stream;
    struct interface *interface;
};

struct interface { struct port port; int open; char ids[MAX_CAMERAS][64]; uint32_t count; };

static struct { int initialized, open; struct port port; uint8_t *host; char directory[4096]; } tl;
static struct interface card;
static struct device devices[MAX_CAMERAS];
static __thread char last_text[256];
static __thread gc_error last_error;
static pthread_mutex_t global = PTHREAD_MUTEX_INITIALIZER;

static gc_error fail(gc_error error, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(last_text, sizeof last_text, format, arguments);
    va_end(arguments);
    return last_error = error;
}

static word now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (word)t.tv_sec * 1000000000u + (word)t.tv_nsec;
}

static void rest(long ns)
{
    struct timespec t = {0, ns};
    nanosleep(&t, NULL);
}

static word load(const word *at) { return __atomic_load_n(at, __ATOMIC_ACQUIRE); }
static void store(word *at, word value) { __atomic_store_n(at, value, __ATOMIC_RELEASE); }
static word reg(const uint8_t *space, word at) { word v; memcpy(&v, space + at, 8); return v; }
static void set_reg(uint8_t *space, word at, word value) { memcpy(space + at, &value, 8); }

static int gone(const struct device *d)
{
    return !load(&d->words[W_PRESENT]) || load(&d->words[W_PLUGGED]) != d->plugged;
}

/* ---- answers to the "get info" calls */

static gc_error give(int32_t *type, int32_t kind, void *out, size_t *size, const void *value, size_t length)
{
    if (!size) return fail(E_PARAMETER, "no size given");
    if (type) *type = kind;
    if (out) {
        if (*size < length) return fail(E_TOO_SMALL, "%zu bytes for %zu", *size, length);
        memcpy(out, value, length);
    }
    *size = length;
    return OK;
}

static gc_error give_text(int32_t *type, void *out, size_t *size, const char *text)
{
    return give(type, T_STRING, out, size, text, strlen(text) + 1);
}

#define GIVE(kind, ctype, value) do { ctype v_ = (ctype)(value); \
    return give(type, kind, out, size, &v_, sizeof v_); } while (0)

/* ---- files */

static uint8_t *map_file(const char *path, int *fd_out, size_t *size)
{
    struct stat st;
    int fd = open(path, O_RDWR | O_CLOEXEC);
    if (fd < 0) return NULL;
    void *at = fstat(fd, &st) ? MAP_FAILED
             : mmap(NULL, (size_t)st.st_size, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (at == MAP_FAILED) { close(fd); return NULL; }
    *size = (size_t)st.st_size;
    *fd_out = fd;
    return at;
}

static int camera_path(char *path, size_t room, const char *serial)
{
    return snprintf(path, room, "%s/%s%s", tl.directory, serial, SUFFIX) < (int)room;
}

/* Map the words of a camera temporarily; `forget` unmaps them. Absent, unplugged or foreign files are no camera. */
static word *look(const char *serial, int *fd, size_t *size)
{
    char path[4352];
    if (!camera_path(path, sizeof path, serial)) return NULL;
    word *words = (word *)map_file(path, fd, size);
    if (!words) return NULL;
    if (words[W_MAGIC] == MAGIC && words[W_VERSION] == VERSION && load(&words[W_PRESENT])) return words;
    munmap(words, *size);
    close(*fd);
    return NULL;
}

static void forget(word *words, int fd, size_t size) { munmap(words, size); close(fd); }

static int by_name(const void *a, const void *b) { return strcmp(a, b); }

static void list_cameras(struct interface *i)
{
    DIR *directory = opendir(tl.directory);
    struct dirent *entry;
    i->count = 0;
    while (directory && (entry = readdir(directory)) && i->count < MAX_CAMERAS) {
        size_t length = strlen(entry->d_name), tail = strlen(SUFFIX);
        if (length <= tail || length - tail > 63 || strcmp(entry->d_name + length - tail, SUFFIX)) continue;
        char *id = i->ids[i->count];
        memcpy(id, entry->d_name, length - tail);
        id[length - tail] = 0;
        int fd;
        size_t size;
        word *words = look(id, &fd, &size);
        if (!words) continue;
        forget(words, fd, size);
        i->count++;
    }
    if (directory) closedir(directory);
    qsort(i->ids, i->count, sizeof i->ids[0], by_name);
}

/* ---- library */

API gc_error GCInitLib(void)
{
    Dl_info info;
    size_t size;
    int fd;
    char path[4096];
    if (tl.initialized) return fail(E_IN_USE, "initialised already");
    if (!dladdr((void *)GCInitLib, &info)) return fail(E_ERROR, "where am I?");
    if (!realpath(info.dli_fname, path)) return fail(E_ERROR, "where is %s?", info.dli_fname);
    *strrchr(path, '/') = 0;
    memcpy(tl.directory, path, sizeof path);
    if (snprintf(path, sizeof path, "%s/%s", tl.directory, HOST_FILE) >= (int)sizeof path)
        return fail(E_IO, "a longer path than there can be");
    tl.host = map_file(path, &fd, &size);
    if (!tl.host) return fail(E_IO, "%s cannot be opened", path);
    close(fd);
    tl.initialized = 1;
    tl.port = (struct port){"TLSystem", tl.host + PORT_SYSTEM * PORT_BYTES, NULL, PORT_SYSTEM};
    card.port = (struct port){"TLInterface", tl.host + PORT_INTERFACE * PORT_BYTES, NULL, PORT_INTERFACE};
    return OK;
}

API gc_error GCCloseLib(void)
{
    if (!tl.initialized) return fail(E_NOT_INITIALIZED, "not initialised");
    munmap(tl.host, (size_t)(2 * PORT_BYTES));
    tl.initialized = 0;
    return OK;
}

API gc_error GCGetLastError(gc_error *code, char *text, size_t *size)
{
    if (code) *code = last_error;
    return give_text(NULL, text, size, last_text);
}

static gc_error tl_info(int32_t what, int32_t *type, void *out, size_t *size)
{
    switch (what) {
    case 0: return give_text(type, out, size, "acquire-simulated");
    case 1: return give_text(type, out, size, "acquire");
    case 2: return give_text(type, out, size, "simulated producer");
    case 3: return give_text(type, out, size, "1.0");
    case 4: return give_text(type, out, size, "Custom");
    case 5: return give_text(type, out, size, "simulated.cti");
    case 6: return give_text(type, out, size, tl.directory);
    case 7: return give_text(type, out, size, "acquire simulated cameras");
    case 8: GIVE(T_INT32, int32_t, 0);
    case 9: GIVE(T_UINT32, uint32_t, 1);
    case 10: GIVE(T_UINT32, uint32_t, 6);
    }
    return fail(E_NOT_AVAILABLE, "system info %d", what);
}

API gc_error GCGetInfo(int32_t what, int32_t *type, void *out, size_t *size)
{
    return tl_info(what, type, out, size);
}

/* ---- ports */

static word pixel_bits(word format)
{
    switch (format) {
    case PFNC_Mono8: return 8;
    case PFNC_Mono10p: return 10;
    case PFNC_Mono10Packed: case PFNC_Mono12p: case PFNC_Mono12Packed: return 12;
    }
    return 16;
}

static word value_bits(word format)
{
    switch (format) {
    case PFNC_Mono8: return 8;
    case PFNC_Mono10: case PFNC_Mono10p: case PFNC_Mono10Packed: return 10;
    case PFNC_Mono16: return 16;
    }
    return 12;
}

static word row_bytes(struct device *d)
{
    const uint8_t *r = d->remote.space;
    return (reg(r, REG_Width) * pixel_bits(reg(r, REG_PixelFormat)) + 7) / 8;
}

static word pitch(struct device *d) { return row_bytes(d) + d->words[W_ROW_PADDING]; }

static uint8_t *stream_space(struct device *d)
{
    return (uint8_t *)d->words + PORTS_AT + PORT_STREAM * PORT_BYTES;
}

static void derive(struct device *d)
{
    word height = reg(stream_space(d), REG_BufferHeight);
    set_reg(d->remote.space, REG_PayloadSize, pitch(d) * height);
    set_reg(stream_space(d), REG_StreamPayloadSize, pitch(d) * height);
}

/* Ask the feeding side for a session (odd: acquire, even: idle) and wait for its answer. */
static gc_error ask(struct device *d, int acquire)
{
    word session = load(&d->words[W_SESSION]), until = now_ns() + ANSWER_NS;
    if ((session & 1) != (word)acquire) {
        /* The stream's thread alone writes TAIL: it may still be taking lines of the session before. */
        if (acquire) store(&d->words[W_BEGIN], load(&d->words[W_HEAD]));
        store(&d->words[W_SESSION], ++session);
    }
    while (load(&d->words[W_ACK]) != session) {
        if (gone(d)) return fail(E_IO, "camera %s is gone", d->serial);
        if (now_ns() > until) return fail(E_TIMEOUT, "nobody feeds the simulated camera %s", d->serial);
        rest(TICK_NS);
    }
    return OK;
}

static gc_error port_check(struct port *p, word at, size_t size)
{
    if (!p || !p->space) return fail(E_HANDLE, "no port");
    if (at + size > PORT_BYTES || at + size < at) return fail(E_ADDRESS, "%zu bytes at %#lx", size, at);
    if (p->device && gone(p->device)) return fail(E_IO, "camera %s is gone", p->device->serial);
    return OK;
}

API gc_error GCReadPort(struct port *p, uint64_t at, void *out, size_t *size)
{
    gc_error error = port_check(p, at, *size);
    if (!error) memcpy(out, p->space + at, *size);
    return error;
}

API gc_error GCWritePort(struct port *p, uint64_t at, const void *in, size_t *size)
{
    gc_error error = port_check(p, at, *size);
    if (error) return error;
    if (p->device && p->number == PORT_REMOTE) {
        if (at == REG_AcquisitionStart) return ask(p->device, 1);
        if (at == REG_AcquisitionStop) return ask(p->device, 0);
    }
    if (p->device && p->number == PORT_STREAM && at == REG_BufferHeight && p->device->stream
        && p->device->stream->running)
        return fail(E_BUSY, "BufferHeight while acquiring");
    memcpy(p->space + at, in, *size);
    if (p->device) derive(p->device);
    return OK;
}

struct entry { uint64_t at; void *memory; size_t size; };

static gc_error stacked(struct port *p, struct entry *entries, size_t *count, int writing)
{
    size_t n = *count;
    for (*count = 0; *count < n; ++*count) {
        struct entry *e = &entries[*count];
        gc_error error = writing ? GCWritePort(p, e->at, e->memory, &e->size)
                                 : GCReadPort(p, e->at, e->memory, &e->size);
        if (error) return error;
    }
    return OK;
}

API gc_error GCReadPortStacked(struct port *p, struct entry *e, size_t *n) { return stacked(p, e, n, 0); }
API gc_error GCWritePortStacked(struct port *p, struct entry *e, size_t *n) { return stacked(p, e, n, 1); }

API gc_error GCGetPortURL(struct port *p, char *url, size_t *size)
{
    if (!p || !p->space) return fail(E_HANDLE, "no port");
    return give_text(NULL, url, size, (char *)p->space + URL_AT);
}

API gc_error GCGetNumPortURLs(struct port *p, uint32_t *count)
{
    if (!p || !p->space) return fail(E_HANDLE, "no port");
    *count = 1;
    return OK;
}

API gc_error GCGetPortURLInfo(struct port *p, uint32_t index, int32_t what, int32_t *type, void *out, size_t *size)
{
    unsigned long at, length;
    char *url, name[64];
    if (!p || !p->space) return fail(E_HANDLE, "no port");
    if (index) return fail(E_INDEX, "URL %u of 1", index);
    url = (char *)p->space + URL_AT;
    if (sscanf(url, "local:%63[^;];%lx;%lx", name, &at, &length) != 3) return fail(E_ERROR, "bad URL");
    switch (what) {
    case 0: return give_text(type, out, size, url);
    case 1: case 2: case 3: GIVE(T_INT32, int32_t, 1);
    case 4: case 5: case 9: GIVE(T_INT32, int32_t, 0);
    case 7: GIVE(T_UINT64, uint64_t, at);
    case 8: GIVE(T_UINT64, uint64_t, length);
    case 10: return give_text(type, out, size, name);
    }
    return fail(E_NOT_AVAILABLE, "URL info %d", what);
}

API gc_error GCGetPortInfo(struct port *p, int32_t what, int32_t *type, void *out, size_t *size)
{
    if (!p || !p->space) return fail(E_HANDLE, "no port");
    switch (what) {
    case 0: return give_text(type, out, size, p->name);
    case 1: return give_text(type, out, size, "acquire");
    case 2: return give_text(type, out, size, p->name);
    case 3: return give_text(type, out, size, "Custom");
    case 4: return give_text(type, out, size, p->name);
    case 5: case 7: case 8: GIVE(T_BOOL8, uint8_t, 1);
    case 6: case 9: case 10: GIVE(T_BOOL8, uint8_t, 0);
    case 11: return give_text(type, out, size, "1.0");
    case 12: {
        const char *names[] = {"RemotePort", "DevicePort", "StreamPort"};
        const char *host[] = {"SystemPort", "InterfacePort"};
        return give_text(type, out, size, p->device ? names[p->number] : host[p->number]);
    }
    }
    return fail(E_NOT_AVAILABLE, "port info %d", what);
}

/* ---- system and interface: one of each */

API gc_error TLOpen(void **handle)
{
    if (!tl.initialized) return fail(E_NOT_INITIALIZED, "not initialised");
    if (tl.open) return fail(E_IN_USE, "the system is open");
    tl.open = 1;
    *handle = &tl.port;
    return OK;
}

static gc_error is_tl(void *handle) { return handle == &tl.port && tl.open ? OK : fail(E_HANDLE, "no system"); }
static gc_error is_if(void *handle) { return handle == &card.port && card.open ? OK : fail(E_HANDLE, "no interface"); }

API gc_error TLClose(void *handle)
{
    if (is_tl(handle)) return E_HANDLE;
    tl.open = 0;
    return OK;
}

API gc_error TLGetInfo(void *handle, int32_t what, int32_t *type, void *out, size_t *size)
{
    return is_tl(handle) ? E_HANDLE : tl_info(what, type, out, size);
}

API gc_error TLUpdateInterfaceList(void *handle, uint8_t *changed, uint64_t timeout_ms)
{
    (void)timeout_ms;
    if (changed) *changed = 0;
    return is_tl(handle);
}

API gc_error TLGetNumInterfaces(void *handle, uint32_t *count) { *count = 1; return is_tl(handle); }

API gc_error TLGetInterfaceID(void *handle, uint32_t index, char *id, size_t *size)
{
    if (is_tl(handle)) return E_HANDLE;
    return index ? fail(E_INDEX, "interface %u of 1", index) : give_text(NULL, id, size, "card0");
}

static gc_error if_info(int32_t what, int32_t *type, void *out, size_t *size)
{
    switch (what) {
    case 0: return give_text(type, out, size, "card0");
    case 1: return give_text(type, out, size, "simulated grabber");
    case 2: return give_text(type, out, size, "Custom");
    }
    return fail(E_NOT_AVAILABLE, "interface info %d", what);
}

API gc_error TLGetInterfaceInfo(void *handle, const char *id, int32_t what, int32_t *type, void *out, size_t *size)
{
    if (is_tl(handle)) return E_HANDLE;
    return strcmp(id, "card0") ? fail(E_ID, "interface %s", id) : if_info(what, type, out, size);
}

API gc_error TLOpenInterface(void *handle, const char *id, void **out)
{
    if (is_tl(handle)) return E_HANDLE;
    if (strcmp(id, "card0")) return fail(E_ID, "interface %s", id);
    if (card.open) return fail(E_IN_USE, "the interface is open");
    card.open = 1;
    *out = &card.port;
    return OK;
}

API gc_error IFClose(void *handle)
{
    if (is_if(handle)) return E_HANDLE;
    card.open = 0;
    return OK;
}

API gc_error IFGetInfo(void *handle, int32_t what, int32_t *type, void *out, size_t *size)
{
    return is_if(handle) ? E_HANDLE : if_info(what, type, out, size);
}

API gc_error IFGetParentTL(void *handle, void **parent) { *parent = &tl.port; return is_if(handle); }

API gc_error IFUpdateDeviceList(void *handle, uint8_t *changed, uint64_t timeout_ms)
{
    (void)timeout_ms;
    if (is_if(handle)) return E_HANDLE;
    pthread_mutex_lock(&global);
    list_cameras(&card);
    pthread_mutex_unlock(&global);
    if (changed) *changed = 1;
    return OK;
}

API gc_error IFGetNumDevices(void *handle, uint32_t *count) { *count = card.count; return is_if(handle); }

API gc_error IFGetDeviceID(void *handle, uint32_t index, char *id, size_t *size)
{
    if (is_if(handle)) return E_HANDLE;
    if (index >= card.count) return fail(E_INDEX, "device %u of %u", index, card.count);
    return give_text(NULL, id, size, card.ids[index]);
}

/* A lock of the open file, which ends with it. Unlike flock(2), it can be looked at without being taken: a camera
 * that is only looked at can be opened at that moment. */
static struct flock whole_file(void) { return (struct flock){.l_type = F_WRLCK, .l_whence = SEEK_SET}; }

static int lock(int fd)
{
    struct flock all = whole_file();
    return fcntl(fd, F_OFD_SETLK, &all);
}

/* 1: free, 5: open here, 4: open somewhere else */
static int32_t access_status(const char *serial, int fd)
{
    struct flock held = whole_file();
    for (int k = 0; k < MAX_CAMERAS; k++)
        if (devices[k].open && !strcmp(devices[k].serial, serial)) return 5;
    return fcntl(fd, F_OFD_GETLK, &held) || held.l_type != F_UNLCK ? 4 : 1;
}

static gc_error device_info(const word *words, int fd, const char *serial, int32_t what, int32_t *type, void *out, size_t *size)
{
    const char *texts = (const char *)words;
    char display[160];
    switch (what) {
    case 0: return give_text(type, out, size, serial);
    case 1: return give_text(type, out, size, texts + VENDOR_AT);
    case 2: return give_text(type, out, size, texts + MODEL_AT);
    case 3: return give_text(type, out, size, "Custom");
    case 4:
        snprintf(display, sizeof display, "%s %s", texts + MODEL_AT, serial);
        return give_text(type, out, size, display);
    case 5: GIVE(T_INT32, int32_t, access_status(serial, fd));
    case 6: return give_text(type, out, size, "");
    case 7: return give_text(type, out, size, texts + SERIAL_AT);
    case 8: return give_text(type, out, size, texts + FIRMWARE_AT);
    case 9: GIVE(T_UINT64, uint64_t, 1000000000u);
    }
    return fail(E_NOT_AVAILABLE, "device info %d", what);
}

API gc_error IFGetDeviceInfo(void *handle, const char *id, int32_t what, int32_t *type, void *out, size_t *size)
{
    int fd;
    size_t length;
    word *words;
    if (is_if(handle)) return E_HANDLE;
    if (!(words = look(id, &fd, &length))) return fail(E_ID, "there is no camera %s", id);
    gc_error error = device_info(words, fd, id, what, type, out, size);
    forget(words, fd, length);
    return error;
}

/* ---- device */

static gc_error open_device(struct device *d, const char *serial)
{
    char path[4352];
    memset(d, 0, sizeof *d);
    if (!camera_path(path, sizeof path, serial)) return fail(E_ID, "camera %s", serial);
    d->words = (word *)map_file(path, &d->fd, &d->size);
    if (!d->words || d->words[W_MAGIC] != MAGIC || d->words[W_VERSION] != VERSION || !load(&d->words[W_PRESENT])) {
        if (d->words) forget(d->words, d->fd, d->size);
        return fail(E_ID, "there is no camera %s", serial);
    }
    if (lock(d->fd)) {
        forget(d->words, d->fd, d->size);
        return fail(E_ACCESS, "camera %s is open in another process", serial);
    }
    uint8_t *ports = (uint8_t *)d->words + PORTS_AT;
    snprintf(d->serial, sizeof d->serial, "%s", serial);
    d->plugged = load(&d->words[W_PLUGGED]);
    d->remote = (struct port){"Device", ports + PORT_REMOTE * PORT_BYTES, d, PORT_REMOTE};
    d->local = (struct port){"TLDevice", ports + PORT_DEVICE * PORT_BYTES, d, PORT_DEVICE};
    d->open = 1;
    set_reg(d->remote.space, REG_TLParamsLocked, 0); /* a host that crashed may have left it set */
    derive(d);
    return OK;
}

API gc_error IFOpenDevice(void *handle, const char *id, int32_t access, void **out)
{
    (void)access;
    if (is_if(handle)) return E_HANDLE;
    gc_error error = fail(E_BUSY, "more than %d cameras", MAX_CAMERAS);
    pthread_mutex_lock(&global);
    for (int k = 0; k < MAX_CAMERAS; k++)
        if (!devices[k].open) {
            error = open_device(&devices[k], id);
            *out = &devices[k].local;
            break;
        }
    pthread_mutex_unlock(&global);
    return error;
}

static struct device *device_of(void *handle)
{
    for (int k = 0; k < MAX_CAMERAS; k++)
        if (devices[k].open && handle == &devices[k].local) return &devices[k];
    fail(E_HANDLE, "no device");
    return NULL;
}

API gc_error DSClose(struct stream *s);

API gc_error DevClose(void *handle)
{
    struct device *d = device_of(handle);
    if (!d) return E_HANDLE;
    if (d->stream) DSClose(d->stream);
    if (load(&d->words[W_SESSION]) & 1) store(&d->words[W_SESSION], load(&d->words[W_SESSION]) + 1);
    d->open = 0;
    forget(d->words, d->fd, d->size);
    return OK;
}

API gc_error DevGetInfo(void *handle, int32_t what, int32_t *type, void *out, size_t *size)
{
    struct device *d = device_of(handle);
    return d ? device_info(d->words, d->fd, d->serial, what, type, out, size) : E_HANDLE; /* also after it was unplugged */
}

API gc_error DevGetParentIF(void *handle, void **parent)
{
    *parent = &card.port;
    return device_of(handle) ? OK : E_HANDLE;
}

API gc_error DevGetPort(void *handle, void **port)
{
    struct device *d = device_of(handle);
    if (!d) return E_HANDLE;
    *port = &d->remote;
    return OK;
}

API gc_error DevGetNumDataStreams(void *handle, uint32_t *count) { *count = 1; return device_of(handle) ? OK : E_HANDLE; }

API gc_error DevGetDataStreamID(void *handle, uint32_t index, char *id, size_t *size)
{
    if (!device_of(handle)) return E_HANDLE;
    return index ? fail(E_INDEX, "stream %u of 1", index) : give_text(NULL, id, size, "Stream0");
}

API gc_error DevOpenDataStream(void *handle, const char *id, void **out)
{
    struct device *d = device_of(handle);
    pthread_condattr_t attributes;
    if (!d) return E_HANDLE;
    if (strcmp(id, "Stream0")) return fail(E_ID, "stream %s", id);
    if (d->stream) return fail(E_IN_USE, "the stream is open");
    struct stream *s = calloc(1, sizeof *s);
    if (!s) return fail(E_ERROR, "no memory");
    s->device = d;
    s->port = (struct port){"TLDataStream", stream_space(d), d, PORT_STREAM};
    pthread_mutex_init(&s->lock, NULL);
    pthread_condattr_init(&attributes);
    pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    pthread_cond_init(&s->news, &attributes);
    d->stream = s;
    *out = s;
    return OK;
}

/* ---- queues of buffers; the stream's lock is held */

static void push(struct queue *q, struct buffer *b)
{
    b->next = NULL;
    if (q->last) q->last->next = b; else q->first = b;
    q->last = b;
    q->count++;
}

static struct buffer *pop(struct queue *q)
{
    struct buffer *b = q->first;
    if (b) {
        q->first = b->next;
        if (!q->first) q->last = NULL;
        q->count--;
    }
    return b;
}

static void move_all(struct queue *from, struct queue *to)
{
    struct buffer *b;
    while ((b = pop(from))) {
        b->queued = to != NULL;
        b->waiting = 0;
        if (to) push(to, b);
    }
}

/* ---- from a line to a buffer */

struct shape { word width, offset, height, format, row, pitch, sample_bytes, stride, shift_down, shift_up; };

static struct shape shape_of(struct device *d)
{
    const uint8_t *r = d->remote.space;
    struct shape s = {
        .width = reg(r, REG_Width), .offset = reg(r, REG_OffsetX), .format = reg(r, REG_PixelFormat),
        .height = reg(stream_space(d), REG_BufferHeight), .row = row_bytes(d), .pitch = pitch(d),
        .sample_bytes = d->words[W_SAMPLE_BYTES], .stride = d->words[W_LINE_STRIDE],
    };
    word have = d->words[W_SENSOR_BITS], want = value_bits(s.format);
    s.shift_down = have > want ? have - want : 0;
    s.shift_up = want > have ? want - have : 0;
    return s;
}

static unsigned sample(const struct shape *s, const uint8_t *line, word x)
{
    unsigned v = s->sample_bytes == 1 ? line[x] : (unsigned)line[2 * x] | (unsigned)line[2 * x + 1] << 8;
    return (v >> s->shift_down) << s->shift_up;
}

static void pack_row(const struct shape *s, const uint8_t *line, uint8_t *out)
{
    word bits = pixel_bits(s->format), at = 0;
    line += s->offset * s->sample_bytes;
    if (!s->shift_down && !s->shift_up && bits == 8 * s->sample_bytes) {
        memcpy(out, line, s->row);
    } else if (bits == 8) {
        for (word x = 0; x < s->width; x++) out[x] = (uint8_t)sample(s, line, x);
    } else if (bits == 16) {
        for (word x = 0; x < s->width; x++) {
            unsigned v = sample(s, line, x);
            out[2 * x] = (uint8_t)v;
            out[2 * x + 1] = (uint8_t)(v >> 8);
        }
    } else if (s->format == PFNC_Mono10Packed || s->format == PFNC_Mono12Packed) {
        /* GigE Vision: two pixels in three bytes, the high 8 bits of each on the outside, the rest in the middle */
        unsigned low = value_bits(s->format) == 12 ? 4 : 2, mask = (1u << low) - 1;
        for (word x = 0; x < s->width; x += 2, out += 3) {
            unsigned a = sample(s, line, x), b = x + 1 < s->width ? sample(s, line, x + 1) : 0;
            out[0] = (uint8_t)(a >> low);
            out[1] = (uint8_t)((a & mask) | (b & mask) << 4);
            if (x + 1 < s->width) out[2] = (uint8_t)(b >> low);
        }
    } else { /* PFNC "p": a stream of bits, lowest first */
        memset(out, 0, s->row);
        for (word x = 0; x < s->width; x++) {
            unsigned v = sample(s, line, x);
            for (word bit = 0; bit < bits; bit++, at++) out[at / 8] |= (uint8_t)((v >> bit & 1) << at % 8);
        }
    }
}

/* Find a fault of this kind due at `at` (frame or line) and mark it as done; return its count, or 0. */
static word fault(struct device *d, word kind, word at)
{
    for (word k = 0; k < FAULTS; k++) {
        word *f = d->words + FAULTS_AT + k * FAULT_WORDS;
        if (load(&f[0]) != kind || f[3] || f[1] != at) continue;
        store(&f[3], 1);
        store(&d->words[W_FAULTS_FIRED], d->words[W_FAULTS_FIRED] + 1);
        return f[2];
    }
    return 0;
}

static word id_of(struct device *d, word frame)
{
    word bits = d->words[W_ID_BITS], first = d->words[W_ID_FIRST];
    return bits >= 64 ? first + frame : first + frame % (((word)1 << bits) - first);
}

struct filling { struct buffer *buffer; word frame, lines, line, drop, starve; int bad; word skip, cut; };

static void begin_frame(struct stream *s, const struct shape *shape, struct filling *f)
{
    struct device *d = s->device;
    word count;
    f->bad = 0;
    f->cut = shape->height;
    if ((count = fault(d, FAULT_DROP, f->frame))) f->drop = count;
    if ((count = fault(d, FAULT_OVERRUN, f->frame))) f->starve = count;
    if (fault(d, FAULT_BAD, f->frame)) f->bad = 1;
    if ((count = fault(d, FAULT_SHORT, f->frame))) f->bad = 1, f->cut = count < shape->height ? count : shape->height;
    if (fault(d, FAULT_GONE, f->frame)) store(&d->words[W_PRESENT], 0);
    pthread_mutex_lock(&s->lock);
    s->started++;
    store(&d->words[W_FRAMES], d->words[W_FRAMES] + 1);
    f->buffer = NULL;
    if (f->drop) {
        f->drop--;
    } else if (f->starve || !(f->buffer = pop(&s->input))) {
        if (f->starve) f->starve--;
        s->underruns++;
        store(&d->words[W_UNDERRUNS], s->underruns);
    }
    pthread_mutex_unlock(&s->lock);
}

static void end_frame(struct stream *s, const struct shape *shape, struct filling *f)
{
    struct buffer *b = f->buffer;
    if (b) {
        pthread_mutex_lock(&s->lock);
        if (!f->bad) b->frame_id = id_of(s->device, f->frame); /* else the header is lost, and the old value stays */
        b->height = f->cut;
        b->width = shape->width;
        b->offset = shape->offset;
        b->format = shape->format;
        b->padding = shape->pitch - shape->row;
        b->filled = shape->pitch * f->cut < b->size ? shape->pitch * f->cut : b->size;
        b->too_large = shape->pitch * shape->height > b->size;
        b->incomplete = f->bad || b->too_large;
        b->queued = 0;
        b->waiting = 1;
        s->delivered++;
        s->fired++;
        store(&s->device->words[W_DELIVERED], s->delivered);
        push(&s->output, b);
        pthread_cond_broadcast(&s->news);
        pthread_mutex_unlock(&s->lock);
    }
    f->buffer = NULL;
    f->frame++;
    f->lines = 0;
}

static void take_line(struct stream *s, const struct shape *shape, struct filling *f, word at)
{
    struct device *d = s->device;
    word slot = at % d->words[W_LINE_CAPACITY], missed;
    const uint8_t *base = (const uint8_t *)d->words;
    if (!f->skip && (missed = fault(d, FAULT_MISSED, f->line))) {
        uint8_t *r = d->remote.space;
        set_reg(r, REG_CounterValue, reg(r, REG_CounterValue) + missed);
        f->skip = missed; /* lines whose trigger pulse the camera does not see */
    }
    f->line++;
    if (f->skip) { f->skip--; return; }
    if (!f->lines) {
        begin_frame(s, shape, f);
        if (f->buffer && !f->bad) memcpy(&f->buffer->time_ns, base + d->words[W_HEADERS_AT] + slot * HEADER_BYTES + 8, 8);
    }
    if (f->buffer && f->lines < f->cut && shape->pitch * (f->lines + 1) <= f->buffer->size) {
        uint8_t *out = f->buffer->memory + shape->pitch * f->lines;
        pack_row(shape, base + d->words[W_LINES_AT] + slot * shape->stride, out);
        memset(out + shape->row, 0xAA, shape->pitch - shape->row);
    }
    if (++f->lines == shape->height) end_frame(s, shape, f);
}

static void *fill(void *argument)
{
    struct stream *s = argument;
    struct device *d = s->device;
    struct shape shape = shape_of(d);
    struct filling f = {0};
    word session = s->session; /* not the present one: the host may have started before this thread runs */
    while (!__atomic_load_n(&s->end, __ATOMIC_ACQUIRE)) {
        word tail, head;
        if (load(&d->words[W_SESSION]) != session) { /* a new session counts lines and frames from 0 */
            session = load(&d->words[W_SESSION]);
            if (session & 1) {
                if (f.buffer) { pthread_mutex_lock(&s->lock); push(&s->input, f.buffer); pthread_mutex_unlock(&s->lock); }
                f = (struct filling){0};
                store(&d->words[W_TAIL], load(&d->words[W_BEGIN]));
            }
        }
        if (gone(d)) {
            pthread_mutex_lock(&s->lock);
            pthread_cond_broadcast(&s->news);
            pthread_mutex_unlock(&s->lock);
            rest(TICK_NS);
            continue;
        }
        tail = d->words[W_TAIL];
        head = load(&d->words[W_HEAD]);
        if (load(&d->words[W_SESSION]) != session) continue; /* some of the lines may be of the next one */
        if (!(session & 1) || head == tail) { rest(TICK_NS); continue; }
        for (; tail < head && !gone(d); tail++) {
            take_line(s, &shape, &f, tail);
            if (!(tail & 63)) store(&d->words[W_TAIL], tail + 1);
        }
        store(&d->words[W_TAIL], tail);
    }
    if (f.buffer) { pthread_mutex_lock(&s->lock); push(&s->input, f.buffer); pthread_mutex_unlock(&s->lock); }
    return NULL;
}

/* ---- stream */

static int is_stream(struct stream *s)
{
    for (int k = 0; k < MAX_CAMERAS; k++)
        if (devices[k].open && devices[k].stream == s && s) return 1;
    fail(E_HANDLE, "no stream");
    return 0;
}

static struct buffer *buffer_of(struct stream *s, void *handle)
{
    struct buffer *b;
    if (!is_stream(s)) return NULL;
    for (b = s->all; b && b != handle; b = b->next_all) ;
    if (!b) fail(E_BUFFER, "no buffer of this stream");
    return b;
}

static gc_error announce(struct stream *s, void *memory, size_t size, void *user, int ours, void **out)
{
    struct buffer *b = calloc(1, sizeof *b);
    if (!b) return fail(E_ERROR, "no memory");
    *b = (struct buffer){.memory = memory, .size = size, .user = user, .ours = ours};
    pthread_mutex_lock(&s->lock);
    b->next_all = s->all;
    s->all = b;
    s->announced++;
    pthread_mutex_unlock(&s->lock);
    *out = b;
    return OK;
}

API gc_error DSAnnounceBuffer(struct stream *s, void *memory, size_t size, void *user, void **out)
{
    if (!is_stream(s)) return E_HANDLE;
    return memory ? announce(s, memory, size, user, 0, out) : fail(E_PARAMETER, "no memory given");
}

API gc_error DSAllocAndAnnounceBuffer(struct stream *s, size_t size, void *user, void **out)
{
    if (!is_stream(s)) return E_HANDLE;
    void *memory = calloc(1, size);
    return memory ? announce(s, memory, size, user, 1, out) : fail(E_ERROR, "no memory");
}

API gc_error DSRevokeBuffer(struct stream *s, void *handle, void **memory, void **user)
{
    struct buffer *b = buffer_of(s, handle), **at;
    if (!b) return last_error;
    if (b->queued || b->waiting) return fail(E_BUSY, "the buffer is queued");
    if (memory) *memory = b->ours ? NULL : b->memory;
    if (user) *user = b->user;
    pthread_mutex_lock(&s->lock);
    for (at = &s->all; *at != b; at = &(*at)->next_all) ;
    *at = b->next_all;
    s->announced--;
    pthread_mutex_unlock(&s->lock);
    if (b->ours) free(b->memory);
    free(b);
    return OK;
}

API gc_error DSQueueBuffer(struct stream *s, void *handle)
{
    struct buffer *b = buffer_of(s, handle);
    if (!b) return last_error;
    pthread_mutex_lock(&s->lock);
    gc_error error = b->queued || b->waiting ? fail(E_IN_USE, "the buffer is queued already") : OK;
    if (!error) { b->queued = 1; push(&s->input, b); }
    pthread_mutex_unlock(&s->lock);
    return error;
}

API gc_error DSFlushQueue(struct stream *s, int32_t operation)
{
    if (!is_stream(s)) return E_HANDLE;
    pthread_mutex_lock(&s->lock);
    switch (operation) {
    case 0: {
        struct buffer *b;
        while ((b = pop(&s->input))) { b->queued = 0; b->waiting = 1; b->filled = 0; b->incomplete = 1; push(&s->output, b); }
        break;
    }
    case 1: move_all(&s->output, NULL); break;
    case 2: move_all(&s->output, &s->input); break;
    case 3:
        for (struct buffer *b = s->all; b; b = b->next_all)
            if (!b->queued && !b->waiting) { b->queued = 1; push(&s->input, b); }
        break;
    default: move_all(&s->input, NULL); move_all(&s->output, NULL);
    }
    pthread_mutex_unlock(&s->lock);
    return OK;
}

API gc_error DSStartAcquisition(struct stream *s, int32_t flags, uint64_t count)
{
    (void)flags, (void)count;
    if (!is_stream(s)) return E_HANDLE;
    if (s->running) return fail(E_IN_USE, "acquiring already");
    if (gone(s->device)) return fail(E_IO, "camera %s is gone", s->device->serial);
    gc_error error = ask(s->device, 0); /* a host that crashed may have left a session open */
    if (error) return error;
    s->end = s->killed = 0;
    s->delivered = 0;
    s->session = load(&s->device->words[W_SESSION]);
    if (pthread_create(&s->thread, NULL, fill, s)) return fail(E_ERROR, "no thread");
    s->running = 1;
    return OK;
}

API gc_error DSStopAcquisition(struct stream *s, int32_t flags)
{
    (void)flags;
    if (!is_stream(s)) return E_HANDLE;
    if (!s->running) return fail(E_IN_USE, "not acquiring");
    __atomic_store_n(&s->end, 1, __ATOMIC_RELEASE);
    pthread_join(s->thread, NULL);
    s->running = 0;
    return OK;
}

API gc_error DSClose(struct stream *s)
{
    if (!is_stream(s)) return E_HANDLE;
    if (s->running) DSStopAcquisition(s, 1);
    DSFlushQueue(s, 4);
    while (s->all) DSRevokeBuffer(s, s->all, NULL, NULL);
    s->device->stream = NULL;
    pthread_cond_destroy(&s->news);
    pthread_mutex_destroy(&s->lock);
    free(s);
    return OK;
}

API gc_error DSGetParentDev(struct stream *s, void **parent)
{
    if (!is_stream(s)) return E_HANDLE;
    *parent = &s->device->local;
    return OK;
}

API gc_error DSGetBufferID(struct stream *s, uint32_t index, void **out)
{
    if (!is_stream(s)) return E_HANDLE;
    struct buffer *b = s->all;
    while (b && index--) b = b->next_all;
    *out = b;
    return b ? OK : fail(E_INDEX, "no such buffer");
}

API gc_error DSGetInfo(struct stream *s, int32_t what, int32_t *type, void *out, size_t *size)
{
    if (!is_stream(s)) return E_HANDLE;
    pthread_mutex_lock(&s->lock);
    word delivered = s->delivered, underruns = s->underruns, announced = s->announced, started = s->started;
    size_t queued = s->input.count, waiting = s->output.count;
    pthread_mutex_unlock(&s->lock);
    switch (what) {
    case 0: return give_text(type, out, size, "Stream0");
    case 1: GIVE(T_UINT64, uint64_t, delivered);
    case 2: GIVE(T_UINT64, uint64_t, underruns);
    case 3: GIVE(T_SIZET, size_t, announced);
    case 4: GIVE(T_SIZET, size_t, queued);
    case 5: GIVE(T_SIZET, size_t, waiting);
    case 6: GIVE(T_UINT64, uint64_t, started);
    case 7: GIVE(T_SIZET, size_t, reg(s->port.space, REG_StreamPayloadSize));
    case 8: GIVE(T_BOOL8, uint8_t, s->running);
    case 9: GIVE(T_BOOL8, uint8_t, 1);
    case 10: return give_text(type, out, size, "Custom");
    case 11: GIVE(T_SIZET, size_t, 0);
    case 12: GIVE(T_SIZET, size_t, 2);
    case 13: GIVE(T_SIZET, size_t, 1);
    }
    return fail(E_NOT_AVAILABLE, "stream info %d", what);
}

API gc_error DSGetBufferInfo(struct stream *s, void *handle, int32_t what, int32_t *type, void *out, size_t *size)
{
    struct buffer *b = buffer_of(s, handle);
    if (!b) return last_error;
    switch (what) {
    case 0: GIVE(T_PTR, void *, b->memory);
    case 1: GIVE(T_SIZET, size_t, b->size);
    case 2: GIVE(T_PTR, void *, b->user);
    case 3: case 28: GIVE(T_UINT64, uint64_t, b->time_ns);
    case 4: GIVE(T_BOOL8, uint8_t, b->filled > 0);
    case 5: GIVE(T_BOOL8, uint8_t, b->queued);
    case 6: GIVE(T_BOOL8, uint8_t, 0);
    case 7: GIVE(T_BOOL8, uint8_t, b->incomplete);
    case 8: return give_text(type, out, size, "Custom");
    case 9: case 27: GIVE(T_SIZET, size_t, b->filled);
    case 10: GIVE(T_SIZET, size_t, b->width);
    case 11: GIVE(T_SIZET, size_t, reg(s->port.space, REG_BufferHeight));
    case 12: GIVE(T_SIZET, size_t, b->offset);
    case 13: case 15: case 18: GIVE(T_SIZET, size_t, 0);
    case 14: GIVE(T_SIZET, size_t, b->padding);
    case 16: GIVE(T_UINT64, uint64_t, b->frame_id);
    case 17: GIVE(T_BOOL8, uint8_t, 1);
    case 19: GIVE(T_SIZET, size_t, 1);
    case 20: GIVE(T_UINT64, uint64_t, b->format);
    case 21: GIVE(T_UINT64, uint64_t, 4);
    case 22: GIVE(T_SIZET, size_t, b->height);
    case 26: GIVE(T_INT32, int32_t, 1);
    case 29: GIVE(T_BOOL8, uint8_t, b->too_large);
    case 30: case 31: GIVE(T_BOOL8, uint8_t, 0);
    }
    return fail(E_NOT_AVAILABLE, "buffer info %d", what);
}

/* ---- the one event: a new buffer */

API gc_error GCRegisterEvent(void *source, int32_t kind, void **out)
{
    struct stream *s = source;
    if (kind != EVENT_NEW_BUFFER) return fail(E_NOT_IMPLEMENTED, "event %d", kind);
    if (!is_stream(s)) return E_HANDLE;
    if (s->registered) return fail(E_IN_USE, "registered already");
    s->registered = 1;
    *out = s;
    return OK;
}

API gc_error GCUnregisterEvent(void *source, int32_t kind)
{
    struct stream *s = source;
    if (kind != EVENT_NEW_BUFFER || !is_stream(s)) return fail(E_HANDLE, "event %d", kind);
    s->registered = 0;
    return OK;
}

API gc_error EventGetData(struct stream *s, void *out, size_t *size, uint64_t timeout_ms)
{
    struct timespec until;
    word due;
    gc_error error = OK;
    void *data[2];
    if (!is_stream(s)) return E_HANDLE;
    if (*size < sizeof data) return fail(E_TOO_SMALL, "%zu bytes", *size);
    due = now_ns() + (timeout_ms < 1000000000u ? timeout_ms : 1000000000u) * 1000000u;
    until = (struct timespec){(time_t)(due / 1000000000u), (long)(due % 1000000000u)};
    pthread_mutex_lock(&s->lock);
    while (!s->output.first && !error) {
        if (s->killed) error = fail(E_ABORT, "killed");
        else if (gone(s->device)) error = fail(E_IO, "camera %s is gone", s->device->serial);
        else if (pthread_cond_timedwait(&s->news, &s->lock, &until)) error = fail(E_TIMEOUT, "no buffer in time");
    }
    s->killed = 0;
    if (s->output.first) {
        struct buffer *b = pop(&s->output);
        b->waiting = 0;
        data[0] = b;
        data[1] = b->user;
        memcpy(out, data, sizeof data);
        *size = sizeof data;
        error = OK;
    }
    pthread_mutex_unlock(&s->lock);
    return error;
}

API gc_error EventGetDataInfo(struct stream *s, const void *in, size_t in_size, int32_t what, int32_t *type, void *out, size_t *size)
{
    void *data[2];
    if (!is_stream(s)) return E_HANDLE;
    if (in_size < sizeof data) return fail(E_PARAMETER, "%zu bytes of event", in_size);
    memcpy(data, in, sizeof data);
    switch (what) {
    case 0: GIVE(T_PTR, void *, data[0]);
    case 1: GIVE(T_PTR, void *, data[1]);
    }
    return fail(E_NOT_AVAILABLE, "event data info %d", what);
}

API gc_error EventGetInfo(struct stream *s, int32_t what, int32_t *type, void *out, size_t *size)
{
    if (!is_stream(s)) return E_HANDLE;
    switch (what) {
    case 0: GIVE(T_INT32, int32_t, EVENT_NEW_BUFFER);
    case 1: GIVE(T_SIZET, size_t, s->output.count);
    case 2: GIVE(T_UINT64, uint64_t, s->fired);
    case 3: case 4: GIVE(T_SIZET, size_t, 2 * sizeof(void *));
    }
    return fail(E_NOT_AVAILABLE, "event info %d", what);
}

API gc_error EventFlush(struct stream *s)
{
    return is_stream(s) ? DSFlushQueue(s, 1) : E_HANDLE;
}

API gc_error EventKill(struct stream *s)
{
    if (!is_stream(s)) return E_HANDLE;
    pthread_mutex_lock(&s->lock);
    s->killed = 1;
    pthread_cond_broadcast(&s->news);
    pthread_mutex_unlock(&s->lock);
    return OK;
}

/* ---- functions that simulated cameras do not have */

API gc_error DSGetBufferChunkData(void *s, void *b, void *chunks, size_t *count)
{
    (void)s, (void)b, (void)chunks, (void)count;
    return fail(E_NOT_IMPLEMENTED, "no chunks");
}

#define ABSENT(name) API gc_error name(void) { return fail(E_NOT_IMPLEMENTED, #name); }
ABSENT(DSAnnounceCompositeBuffer)
ABSENT(DSGetNumBufferSegments)
ABSENT(DSGetBufferSegmentInfo)
ABSENT(DSGetNumFlows)
ABSENT(DSGetFlowInfo)
ABSENT(DSGetBufferPartInfo)

API gc_error DSGetNumBufferParts(void *s, void *b, uint32_t *count)
{
    (void)s, (void)b;
    *count = 0;
    return OK;
}
