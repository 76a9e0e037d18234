// A preloaded ptrace() that gives user-mode Linux 6.1 processors with more vector state than it knows (AMX tiles).
//
// It sets its guests' floating-point registers with a buffer of fixed size; the host refuses one that is not as large
// as the processor's whole state (EFAULT), and the guest dies at its first program.  Here the part that it knows is
// passed on in a buffer of whole size.  The rest stays in its initial state, which suits programs that do not use it.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <stdint.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

enum { PRESENT = 512 };  // offset of XSTATE_BV: which parts differ from their initial state (Intel SDM 1, 13.4.2)
static const uint64_t TILES = UINT64_C(3) << 17;
static char whole[1 << 16];  // user-mode Linux has one thread that calls this

long ptrace(enum __ptrace_request request, ...)
{
    va_list given;
    va_start(given, request);
    int pid = va_arg(given, int);
    void *kind = va_arg(given, void *);
    struct iovec *part = va_arg(given, struct iovec *);
    va_end(given);
    static long (*next)(int, int, void *, void *);
    if (!next) *(void **)&next = dlsym(RTLD_NEXT, "ptrace");
    int get = (int)request == PTRACE_GETREGSET, set = (int)request == PTRACE_SETREGSET;
    if (!(get || set) || (uintptr_t)kind != NT_X86_XSTATE) return next(request, pid, kind, part);

    static size_t size;  // of the processor's state
    struct iovec all = {whole, sizeof whole};
    if (get || !size) {
        long result = next(PTRACE_GETREGSET, pid, kind, &all);
        if (result) return result;
        size = all.iov_len;
    }
    all.iov_len = size;
    if (part->iov_len > size) part->iov_len = size;
    if (get) {
        memcpy(part->iov_base, whole, part->iov_len);
        return 0;
    }
    uint64_t present;
    memset(whole, 0, size);
    memcpy(whole, part->iov_base, part->iov_len);
    memcpy(&present, whole + PRESENT, sizeof present);
    present &= ~TILES;
    memcpy(whole + PRESENT, &present, sizeof present);
    return next(PTRACE_SETREGSET, pid, kind, &all);
}
