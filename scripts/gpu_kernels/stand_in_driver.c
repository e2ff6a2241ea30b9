/* A stand-in for NVIDIA's driver library libcuda.so.1, for machines without a GPU.
 *
 * It answers the questions that Taichi and Quadrants ask when they start on CUDA, gives them host memory, writes every
 * module that they load (PTX text) to MODP_PTX_FOLDER, and lists their launches there instead of running them. The
 * device that it presents has the compute capability MODP_PTX_CAPABILITY, for example 90.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef int CUresult; /* 0 is success */
typedef unsigned long long CUdeviceptr;

static const size_t MEMORY = 16ull << 30;
static int modules = 0;

static FILE *file(const char *name, const char *mode) {
    char path[4096];
    const char *folder = getenv("MODP_PTX_FOLDER");
    snprintf(path, sizeof path, "%s/%s", folder ? folder : ".", name);
    FILE *opened = fopen(path, mode);
    if (!opened) {
        perror(path);
        exit(3);
    }
    return opened;
}

static int capability(void) {
    const char *text = getenv("MODP_PTX_CAPABILITY");
    return text ? atoi(text) : 90;
}

/* ---- the device ---- */

CUresult cuDriverGetVersion(int *version) { *version = 12080; return 0; }
CUresult cuDeviceGetCount(int *count) { *count = 1; return 0; }
CUresult cuDeviceGet(int *device, int ordinal) { *device = ordinal; return 0; }

CUresult cuDeviceGetName(char *name, int length, int device) {
    (void)device;
    snprintf(name, (size_t)length, "stand-in sm_%d", capability());
    return 0;
}

CUresult cuDeviceGetAttribute(int *value, int attribute, int device) {
    (void)device;
    switch (attribute) {
        case 1: *value = 1024; break;             /* threads per block */
        case 2: case 3: *value = 1024; break;     /* block dimensions x, y */
        case 4: *value = 64; break;               /* block dimension z */
        case 5: *value = 2147483647; break;       /* grid dimension x */
        case 6: case 7: *value = 65535; break;    /* grid dimensions y, z */
        case 8: *value = 48 << 10; break;         /* shared memory per block */
        case 10: *value = 32; break;              /* threads per warp */
        case 12: *value = 65536; break;           /* registers per block */
        case 16: *value = 128; break;             /* multiprocessors */
        case 39: *value = 1536; break;            /* threads per multiprocessor */
        case 41: *value = 1; break;               /* one address space with the host */
        case 75: *value = capability() / 10; break;
        case 76: *value = capability() % 10; break;
        case 81: *value = 96 << 10; break;        /* shared memory per multiprocessor */
        case 97: *value = 96 << 10; break;        /* shared memory per block, on request */
        case 106: *value = 24; break;             /* blocks per multiprocessor */
        default: *value = 0;
    }
    return 0;
}

CUresult cuGetErrorName(int error, const char **text) { (void)error; *text = "error"; return 0; }
CUresult cuGetErrorString(int error, const char **text) { (void)error; *text = "error"; return 0; }

/* ---- contexts, streams and events: any pointer that is not null ---- */

static CUresult some(void **handle) { static int thing; *handle = &thing; return 0; }
CUresult cuCtxCreate_v2(void **context, unsigned flags, int device) { (void)flags; (void)device; return some(context); }
CUresult cuDevicePrimaryCtxRetain(void **context, int device) { (void)device; return some(context); }
CUresult cuCtxGetCurrent(void **context) { return some(context); }
CUresult cuStreamCreate(void **stream, unsigned flags) { (void)flags; return some(stream); }
CUresult cuEventCreate(void **event, unsigned flags) { (void)flags; return some(event); }
CUresult cuDeviceGetDefaultMemPool(void **pool, int device) { (void)device; return some(pool); }
CUresult cuEventElapsedTime(float *time, void *a, void *b) { (void)a; (void)b; *time = 0; return 0; }

/* ---- memory: the host's, as zeros ---- */

static CUresult take(CUdeviceptr *pointer, size_t bytes) {
    *pointer = (CUdeviceptr)calloc(bytes ? bytes : 1, 1);
    return *pointer ? 0 : 2;
}
static CUresult copy(void *to, const void *from, size_t bytes) {
    if (to && from) memmove(to, from, bytes);
    return 0;
}
CUresult cuMemAlloc_v2(CUdeviceptr *p, size_t bytes) { return take(p, bytes); }
CUresult cuMemAllocManaged(CUdeviceptr *p, size_t bytes, unsigned flags) { (void)flags; return take(p, bytes); }
CUresult cuMemAllocAsync(CUdeviceptr *p, size_t bytes, void *stream) { (void)stream; return take(p, bytes); }
CUresult cuMemAllocHost_v2(CUdeviceptr *p, size_t bytes) { return take(p, bytes); }
CUresult cuMemFree_v2(CUdeviceptr p) { free((void *)p); return 0; }
CUresult cuMemFreeAsync(CUdeviceptr p, void *stream) { (void)stream; free((void *)p); return 0; }
CUresult cuMemFreeHost(void *p) { free(p); return 0; }
CUresult cuMemGetInfo_v2(size_t *left, size_t *total) { *left = *total = MEMORY; return 0; }
CUresult cuMemcpyHtoD_v2(CUdeviceptr to, const void *from, size_t n) { return copy((void *)to, from, n); }
CUresult cuMemcpyDtoH_v2(void *to, CUdeviceptr from, size_t n) { return copy(to, (void *)from, n); }
CUresult cuMemcpyDtoD_v2(CUdeviceptr to, CUdeviceptr from, size_t n) { return copy((void *)to, (void *)from, n); }
CUresult cuMemcpyHtoDAsync_v2(CUdeviceptr to, const void *from, size_t n, void *stream) {
    (void)stream;
    return copy((void *)to, from, n);
}
CUresult cuMemcpyDtoHAsync_v2(void *to, CUdeviceptr from, size_t n, void *stream) {
    (void)stream;
    return copy(to, (void *)from, n);
}
CUresult cuMemsetD8_v2(CUdeviceptr p, unsigned char value, size_t n) {
    if (p && value) memset((void *)p, value, n); /* zero already */
    return 0;
}
/* Every pointer is the device's, so that the engine passes arrays on without copying them. */
CUresult cuPointerGetAttribute(void *value, int attribute, CUdeviceptr p) {
    (void)p;
    if (attribute == 2) *(unsigned *)value = 2;
    return 0;
}

/* ---- modules and launches ---- */

CUresult cuModuleLoadDataEx(void **module, const void *image, unsigned n, void *options, void *values) {
    (void)n; (void)options; (void)values;
    char name[32];
    snprintf(name, sizeof name, "%04d.ptx", modules++);
    FILE *out = file(name, "wb");
    fputs((const char *)image, out);
    fclose(out);
    return some(module);
}
CUresult cuModuleLoadData(void **module, const void *image) { return cuModuleLoadDataEx(module, image, 0, 0, 0); }
CUresult cuModuleGetFunction(void **function, void *module, const char *name) {
    (void)module;
    *function = strdup(name);
    return 0;
}
CUresult cuFuncGetAttribute(int *value, int attribute, void *function) {
    (void)attribute; (void)function;
    *value = 0;
    return 0;
}
CUresult cuOccupancyMaxActiveBlocksPerMultiprocessor(int *blocks, void *function, int threads, size_t shared) {
    (void)function; (void)threads; (void)shared;
    *blocks = 8;
    return 0;
}
CUresult cuLaunchKernel(void *function, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz,
                        unsigned shared, void *stream, void **arguments, void **extra) {
    (void)gx; (void)gy; (void)gz; (void)stream; (void)extra;
    /* The engine's allocator on the device: (runtime, bytes, alignment, result). A result of 0 would be an error. */
    if (!strcmp((const char *)function, "runtime_memory_allocate_aligned"))
        take(*(CUdeviceptr **)arguments[3], *(size_t *)arguments[1]);
    if (getenv("MODP_PTX_QUIET")) return 0;
    FILE *out = file("launches.txt", "a");
    fprintf(out, "%s %u %u\n", (const char *)function, bx * by * bz, shared);
    fclose(out);
    return 0;
}

/* ---- what is looked up and needs no answer but success ---- */

#define SUCCEEDS(name) CUresult name(void) { return 0; }
SUCCEEDS(cuInit)
SUCCEEDS(cuCtxSetCurrent)
SUCCEEDS(cuCtxSetLimit)
SUCCEEDS(cuCtxSynchronize)
SUCCEEDS(cuEventDestroy)
SUCCEEDS(cuEventRecord)
SUCCEEDS(cuEventSynchronize)
SUCCEEDS(cuExternalMemoryGetMappedBuffer)
SUCCEEDS(cuExternalMemoryGetMappedMipmappedArray)
SUCCEEDS(cuFuncSetAttribute)
SUCCEEDS(cuGraphAddEmptyNode)
SUCCEEDS(cuGraphAddKernelNode)
SUCCEEDS(cuGraphAddNode)
SUCCEEDS(cuGraphConditionalHandleCreate)
SUCCEEDS(cuGraphCreate)
SUCCEEDS(cuGraphDestroy)
SUCCEEDS(cuGraphExecDestroy)
SUCCEEDS(cuGraphInstantiate)
SUCCEEDS(cuGraphLaunch)
SUCCEEDS(cuImportExternalMemory)
SUCCEEDS(cuImportExternalSemaphore)
SUCCEEDS(cuLinkAddData_v2)
SUCCEEDS(cuLinkAddFile_v2)
SUCCEEDS(cuLinkComplete)
SUCCEEDS(cuLinkCreate_v2)
SUCCEEDS(cuLinkDestroy)
SUCCEEDS(cuMemAdvise)
SUCCEEDS(cuMemPoolSetAttribute)
SUCCEEDS(cuMemPoolTrimTo)
SUCCEEDS(cuMemsetD32_v2)
SUCCEEDS(cuMipmappedArrayGetLevel)
SUCCEEDS(cuSignalExternalSemaphoresAsync)
SUCCEEDS(cuStreamDestroy_v2)
SUCCEEDS(cuStreamSynchronize)
SUCCEEDS(cuStreamWaitEvent)
SUCCEEDS(cuSurfObjectCreate)
SUCCEEDS(cuWaitExternalSemaphoresAsync)
