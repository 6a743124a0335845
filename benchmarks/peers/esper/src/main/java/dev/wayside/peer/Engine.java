package dev.wayside.peer;

import com.espertech.esper.common.client.EPCompiled;
import com.espertech.esper.common.client.configuration.Configuration;
import com.espertech.esper.compiler.client.CompilerArguments;
import com.espertech.esper.compiler.client.EPCompileException;
import com.espertech.esper.compiler.client.EPCompilerProvider;
import com.espertech.esper.runtime.client.DeploymentOptions;
import com.espertech.esper.runtime.client.EPDeployException;
import com.espertech.esper.runtime.client.EPDeployment;
import com.espertech.esper.runtime.client.EPEventService;
import com.espertech.esper.runtime.client.EPRuntime;
import com.espertech.esper.runtime.client.EPRuntimeProvider;
import com.espertech.esper.runtime.client.EPStatement;

/** An Esper runtime of one thread whose clock we advance. */
final class Engine {
    private final Configuration configuration;
    private final EPRuntime runtime;
    final EPEventService events;

    /** An engine whose clock stands at a time in milliseconds, and that knows these classes as event types. */
    Engine(long time, Class<?>... types) {
        configuration = new Configuration();
        configuration.getRuntime().getThreading().setInternalTimerEnabled(false);
        configuration.getRuntime().getThreading().setListenerDispatchPreserveOrder(false);
        configuration.getRuntime().getThreading().setInsertIntoDispatchPreserveOrder(false);
        configuration.getRuntime().getExecution().setPrioritized(false);
        configuration.getCompiler().getByteCode().setAccessModifiersPublic();
        for (Class<?> type : types) {
            configuration.getCommon().addEventType(type);
        }
        runtime = EPRuntimeProvider.getRuntime("peer", configuration);
        events = runtime.getEventService();
        events.advanceTime(time);
    }

    /** Compiles and deploys a module; returns its last statement. */
    EPStatement deploy(String module) throws EPCompileException, EPDeployException {
        CompilerArguments arguments = new CompilerArguments(configuration);
        arguments.getPath().add(runtime.getRuntimePath());
        EPCompiled compiled = EPCompilerProvider.getCompiler().compile(module, arguments);
        EPDeployment deployment = runtime.getDeploymentService().deploy(compiled, new DeploymentOptions());
        EPStatement[] statements = deployment.getStatements();
        return statements[statements.length - 1];
    }
}
