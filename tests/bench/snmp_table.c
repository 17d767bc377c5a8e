/* A table of ROWS x COLUMNS Integer32 for net-snmp's snmpd, held in its own memory: what a C agent does at its best.
 *
 * Loaded by `dlmod snmp_table /path/to/snmp_table.so`. Cells are TABLE.1.column.row for column 1..COLUMNS and
 * row 1..ROWS; a cell holds 1000 * row + column.
 */
#include <net-snmp/net-snmp-config.h>
#include <net-snmp/net-snmp-includes.h>
#include <net-snmp/agent/net-snmp-agent-includes.h>

#define ROWS 200
#define COLUMNS 80

static const oid table_oid[] = {1, 3, 6, 1, 4, 1, 32473, 99, 1};

static int answer(netsnmp_mib_handler *handler, netsnmp_handler_registration *registered,
          netsnmp_agent_request_info *about, netsnmp_request_info *requests)
{
    netsnmp_request_info *one;

    (void)handler;
    (void)registered;
    for (one = requests; one; one = one->next) {
        long *row = netsnmp_tdata_extract_entry(one);
        netsnmp_table_request_info *where = netsnmp_extract_table_info(one);
        long cell;

        if (one->processed)
            continue;
        if (!row || !where) {
            netsnmp_set_request_error(about, one, SNMP_NOSUCHINSTANCE);
            continue;
        }
        cell = *row * 1000 + (long)where->colnum;
        snmp_set_var_typed_integer(one->requestvb, ASN_INTEGER, cell);
    }
    return SNMP_ERR_NOERROR;
}

void init_snmp_table(void)
{
    netsnmp_tdata *data = netsnmp_tdata_create_table("snmp_table", 0);
    netsnmp_table_registration_info *info = SNMP_MALLOC_TYPEDEF(netsnmp_table_registration_info);
    netsnmp_handler_registration *registered = netsnmp_create_handler_registration(
        "snmp_table", answer, table_oid, OID_LENGTH(table_oid), HANDLER_CAN_RONLY);
    long number;

    netsnmp_table_helper_add_indexes(info, ASN_INTEGER, 0);
    info->min_column = 1;
    info->max_column = COLUMNS;
    netsnmp_tdata_register(registered, data, info);
    for (number = 1; number <= ROWS; number++) {
        netsnmp_tdata_row *row = netsnmp_tdata_create_row();
        long *kept = malloc(sizeof *kept);

        *kept = number;
        row->data = kept;
        netsnmp_tdata_row_add_index(row, ASN_INTEGER, &number, sizeof number);
        netsnmp_tdata_add_row(data, row);
    }
}
