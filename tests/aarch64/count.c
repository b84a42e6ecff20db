/* Counts the instructions that a program under qemu-aarch64 executes, and writes the count at every mark.
 *
 * A mark is the system call sched_get_priority_max, which nothing else in that program makes. The few declarations
 * of QEMU's plugin interface (docs/devel/tcg-plugins) stand here because Debian ships its header in no package. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

typedef uint64_t plugin_id;
struct tb;
extern size_t qemu_plugin_tb_n_insns(const struct tb *);
extern void qemu_plugin_register_vcpu_tb_trans_cb(plugin_id, void (*)(plugin_id, struct tb *));
extern void qemu_plugin_register_vcpu_tb_exec_cb(struct tb *, void (*)(unsigned, void *), int, void *);
extern void qemu_plugin_register_vcpu_syscall_cb(plugin_id, void (*)(plugin_id, unsigned, int64_t, uint64_t, uint64_t,
                                                 uint64_t, uint64_t, uint64_t, uint64_t, uint64_t, uint64_t));

enum { NO_REGISTERS = 0, SCHED_GET_PRIORITY_MAX = 125 }; /* of aarch64 Linux */
__attribute__((visibility("default"))) int qemu_plugin_version = 1; /* of the interface, in QEMU 7.2 */
static uint64_t executed; /* exact while the program has one thread */
static FILE *marks;

static void on_block(unsigned cpu, void *instructions) { executed += (uintptr_t)instructions; }

static void on_translate(plugin_id id, struct tb *block) {
    qemu_plugin_register_vcpu_tb_exec_cb(block, on_block, NO_REGISTERS, (void *)(uintptr_t)qemu_plugin_tb_n_insns(block));
}

static void on_syscall(plugin_id id, unsigned cpu, int64_t number, uint64_t a1, uint64_t a2, uint64_t a3, uint64_t a4,
                       uint64_t a5, uint64_t a6, uint64_t a7, uint64_t a8) {
    if (number == SCHED_GET_PRIORITY_MAX) {
        fprintf(marks, "%" PRIu64 "\n", executed);
        fflush(marks);
    }
}

/* The second argument is QEMU's description of itself, which is not read; the only option is to=FILE. */
__attribute__((visibility("default"))) int qemu_plugin_install(plugin_id id, const void *info, int count, char **options) {
    if (count != 1 || strncmp(options[0], "to=", 3) != 0 || (marks = fopen(options[0] + 3, "w")) == NULL)
        return fprintf(stderr, "count: one option is needed, to=FILE, and FILE must be writable\n"), -1;
    qemu_plugin_register_vcpu_tb_trans_cb(id, on_translate);
    qemu_plugin_register_vcpu_syscall_cb(id, on_syscall);
    return 0;
}
